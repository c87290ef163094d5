"""An orthoflow plugin with a kind and a product of its own: cracks in orthoimages, as lines."""

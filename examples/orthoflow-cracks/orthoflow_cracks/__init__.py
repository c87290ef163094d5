"""An orthoflow plugin with its own kind and product: cracks in orthoimages, as lines."""

"""Two sources of numbers and methods that do whatever a test asks of them."""

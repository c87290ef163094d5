"""Export of orthoimages as tiles, and a page that shows them without a server."""

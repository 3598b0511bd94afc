"""A small convolutional network per fused view: what its outputs add to the graph of pieces."""

"""Discovery by a small network over pieces of the chunk's cloud, trained by ourselves (see training/)."""

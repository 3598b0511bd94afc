"""What a frame shows of one point: nothing, a surface where it should be, or free space through it."""

UNTOLD, MET, FREE = 0, 1, 2

"""Image geometry of a camera over a road: arrays in, arrays out, by OpenCV."""

"""A street as a camera on a car sees it: a random scene along a path, drawn with OpenCV and NumPy."""

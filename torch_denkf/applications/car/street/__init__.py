"""Renderer of a street for a camera on a car: a random scene along a path, drawn with OpenCV and NumPy."""

from .signs import PICTURE_SIGNS, picture_signs

__all__ = [
    "PICTURE_SIGNS",
    "picture_signs",
]

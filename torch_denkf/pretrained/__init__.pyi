from .folders import available, from_pretrained, save_pretrained

__all__ = [
    "available",
    "from_pretrained",
    "save_pretrained",
]

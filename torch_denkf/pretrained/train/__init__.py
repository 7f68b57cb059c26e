"""How the filters of the library were trained: ``python -m torch_denkf.pretrained.train NAME --out FOLDER``."""

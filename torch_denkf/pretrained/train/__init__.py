"""The programs that trained the filters of the library: ``python -m torch_denkf.pretrained.train NAME --out FOLDER``."""

"""A drive as stereo corners and turn rates: its files, the motion that the corners show, its replay."""

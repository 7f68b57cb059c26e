"""Finds real recordings: tests that need them are skipped where they are not."""

import os
from pathlib import Path

SHARED = Path(__file__).parents[2] / "shared" / "data"
KITTI = Path(os.environ.get("TORCH_DENKF_KITTI", SHARED / "kitti"))  # with sequences/ and poses/

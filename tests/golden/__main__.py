"""Writes the golden values again: ``python -m tests.golden``. The commit that changes one says why."""

import json

from tests.golden.library import FILE, values

lines = (f"{json.dumps(name)}: {json.dumps(found)}" for name, found in sorted(values().items()))
FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n")

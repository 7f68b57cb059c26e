"""Saves a model over an earlier one, killed at each call that opens, writes or changes a file; says what is there then.

python -m tests.deployment.killed_saves FOLDER
"""

import json
import os
import signal
import sys
from pathlib import Path

import torch
from torch import nn

from torch_denkf.deployment.folder import load_folder, save_folder

#: What a save may call of the operating system.
CALLS = ("open", "close", "write", "ftruncate", "fsync", "replace", "unlink")


def line(size):
    return nn.Linear(size, 1, bias=False)


def save(folder, size):
    """The first model has 2 weights of 2, the second one 3 weights of 3."""
    model = line(size)
    nn.init.constant_(model.weight, float(size))
    save_folder(model, folder, builder="line", settings={"size": size})


def killed(folder, count):
    """Saves the second model in a new process that dies at its ``count``-th call; how that ended."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    left = [count]

    def watch(call):
        def watched(*args, **kwargs):
            left[0] -= 1
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return call(*args, **kwargs)

        return watched

    for name in CALLS:
        setattr(os, name, watch(getattr(os, name)))
    save(folder, 3)
    os._exit(0)


def main(root):
    torch.set_num_threads(1)
    code, found = -signal.SIGKILL, []
    while code:
        folder = root / str(len(found))
        save(folder, 2)
        code = killed(folder, len(found) + 1)
        try:
            there = load_folder(folder, {"line": line}).weight.flatten().tolist()
        except (OSError, ValueError) as error:
            there = str(error)
        save(folder, 3)
        found.append({"code": code, "there": there, "later": sorted(os.listdir(folder))})
    sys.stdout.write(json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]))

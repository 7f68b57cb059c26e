"""Entries of the reacher in the library's registers."""

BUILDERS = {"reacher": "torch_denkf.applications.reacher.filter:reacher"}
COMMANDS = {
    "train-reacher": ("torch_denkf.applications.reacher.commands:TrainReacher", "train or test the reacher's filter")
}

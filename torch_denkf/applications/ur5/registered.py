"""Entries of the UR5 table in the library's registers."""

BUILDERS = {"ur5-table": "torch_denkf.applications.ur5.filter:ur5_table"}
COMMANDS = {
    "collect-ur5": (
        "torch_denkf.applications.ur5.commands.collect_ur5:CollectUR5",
        "collect demonstrations of the UR5 table",
    ),
    "train-ur5": ("torch_denkf.applications.ur5.commands.train_ur5:TrainUR5", "train or test the UR5 table's filter"),
}

"""Entries of the car in the library's registers."""

BUILDERS = {"car": "torch_denkf.applications.car.odometry.filter:car_filter"}
COMMANDS = {
    "demo": (
        "torch_denkf.applications.car.commands.demo:Demo",
        "watch a trained filter follow a car whose camera fails",
    ),
    "render-kitti": (
        "torch_denkf.applications.car.commands.render_kitti:RenderKITTI",
        "render drives in KITTI's layout",
    ),
    "train": (
        "torch_denkf.applications.car.commands.train:Train",
        "train a car's filter on rendered or recorded drives",
    ),
    "evaluate": (
        "torch_denkf.applications.car.commands.evaluate:Evaluate",
        "errors of a trained filter on drives with known poses",
    ),
    "odometry": (
        "torch_denkf.applications.car.commands.odometry:Odometry",
        "the path of a car from its camera's images or video",
    ),
    "plot": ("torch_denkf.applications.car.commands.plot:Plot", "draw a path and its uncertainty"),
}

"""The UR5 table in MuJoCo: the scene, its tasks and looks, the arm's kinematics, and its camera."""

"""Where inputs come in: a module for each border, with a function ``cases`` that returns its damaged inputs."""

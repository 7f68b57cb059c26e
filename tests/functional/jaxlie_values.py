"""Writes what jaxlie makes of random tangents, in its own order of numbers, for test_manifolds.py.

jaxlie needs jax, 600 MB, which the tests do not install. In an environment of its own:
``pip install jaxlie==1.5.0 jax==0.10.2 && python tests/functional/jaxlie_values.py``.
"""

import json
from pathlib import Path

FILE = Path(__file__).with_suffix(".json")


def main():
    """Pairs of tangents, their points, products, logarithms and adjoints. jaxlie loses digits of smaller rotations."""
    import jax
    import jaxlie
    import numpy as np

    jax.config.update("jax_enable_x64", True)
    rng = np.random.default_rng(0)
    cases = []
    for kind in (jaxlie.SO3, jaxlie.SE2, jaxlie.SE3):
        for size in (1e-2, 0.1, 0.5, 1.5, 3.0):
            first, second = rng.normal(size=(2, kind.tangent_dim))
            turn = slice(2, 3) if kind is jaxlie.SE2 else slice(kind.tangent_dim - 3, None)
            first[turn] *= size / np.linalg.norm(first[turn])
            x, y = kind.exp(first), kind.exp(second)
            both = x @ y
            found = {"first": first, "second": second, "exp": x.parameters(), "log": x.log(), "adjoint": x.adjoint()}
            found |= {"compose": both.parameters(), "log of compose": both.log(), "inverse": x.inverse().parameters()}
            cases.append({"kind": kind.__name__, **{name: np.asarray(value).tolist() for name, value in found.items()}})
    FILE.write_text("[\n" + ",\n".join(json.dumps(case) for case in cases) + "\n]\n")


if __name__ == "__main__":
    main()

"""Error against milliseconds a step: the trained DEnKF at all sizes and with three updates, and the other filters.

Weights are those that the table's filters were trained with; nothing is trained again. An update that a filter was not
trained with gets its own inflation, chosen as training chooses it, with the table's number of members. Size and update
are chosen by the validation demos, column ``validation_crps``.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

from benchmarks.common.jobs import once, read_rows
from benchmarks.common.plots import draw_frontier
from benchmarks.common.tables import Columns
from benchmarks.common.training import read_filter
from benchmarks.ur5.evaluation import size_rows
from benchmarks.ur5.readings import read_all, with_missing
from benchmarks.ur5.recipes import UR5Recipe
from benchmarks.ur5.sensors import MEMBERS
from benchmarks.ur5.study import Base, Study, members_of
from benchmarks.ur5.training import INFLATIONS, joint_coverage, run_filter
from torch_denkf.modules import ImageSensor
from torch_denkf.training import choose_for_coverage
from torch_denkf.training.checkpoint import read_checkpoint

SCHEMES = ("sensor", "perturbed", "sakov")  # of the DEnKF's update; "etkf" takes no localisation
SHOWN = 3.0  # degrees: the particle filters err by more
COLUMNS = Columns(
    (
        *("filter", "sensor", "members", "seed", "validation_crps", "joint_mae_deg", "ee_mae_cm", "coverage90"),
        *("ms_per_step", "eager_ms_per_step", "demos"),
    ),
    text=("filter", "sensor"),
    whole=("members", "seed", "demos"),
    order=lambda row: (row["sensor"], row["filter"], row["members"], row["seed"]),
)


def draw(study: Study) -> list[Path]:
    """Times and tests what the table left in ``--out``; leaves frontier.csv and frontier.png there.

    Raises:
        FileNotFoundError: if no filter is trained yet.
    """
    for seed in study.seeds:
        base = Base(study, study.sensors[0], "sim", seed)
        for name in study.filters:
            if (study.out / "filters" / f"{name}-{base.name}" / "filter.pt").exists():
                file = study.out / "frontier" / f"{name}-{base.name}.json"
                once(file, lambda base=base, name=name: list(_rows(base, name)))
    rows = read_rows(sorted((study.out / "frontier").glob("*.json")))
    if not rows:
        raise FileNotFoundError(
            f"no trained filter in {study.out / 'filters'}; run the table first, with --out {study.out}"
        )
    files = [study.out / f"frontier.{kind}" for kind in ("csv", "png")]
    COLUMNS.write(rows, files[0])
    draw_frontier(rows, files[1], error="joint_mae_deg", label="joints, mean absolute error, deg", limit=SHOWN)
    return files


def _rows(base: Base, name: str) -> Iterator[dict]:
    sensor = base.train(name)[0].sensor  # with the head that the filter was trained with
    saved = read_checkpoint(base.study.out / "filters" / f"{name}-{base.name}" / "filter.pt")
    for scheme in SCHEMES if name == "denkf" else (None,):
        names = {"filter": f"DEnKF, {scheme}" if scheme else name, "sensor": base.kind, "seed": base.seed}
        make, sizes = partial(_recipe, base, name, scheme), base.study.sizes if scheme else (MEMBERS,)
        own = {**saved, "inflation": _inflation(base, make(MEMBERS), sensor, saved)} if scheme in SCHEMES[1:] else saved
        chunk = 0 if base.study.smoke else 1
        for row in size_rows(
            make, sensor, base.codes("test"), sizes, own, names, base.codes("validation"), chunk=chunk
        ):
            row["members"] = row["ensemble_size"] if scheme else members_of(name)
            yield {column: row[column] for column in COLUMNS.names}


def _inflation(base: Base, recipe: UR5Recipe, sensor: ImageSensor, saved: dict) -> float:
    """Chooses the inflation of a recipe's update, by the validation demos' coverage."""
    model = read_filter(recipe, recipe.build(), saved)
    readings = with_missing(read_all(sensor, base.codes("validation"), MEMBERS))
    return choose_for_coverage(
        INFLATIONS,
        lambda factor: recipe.set_inflation(model, factor),
        lambda: joint_coverage(run_filter(recipe, model, readings)),
    )


def _recipe(base: Base, name: str, scheme: str | None, size: int) -> UR5Recipe:
    recipe = base.recipe(name, size)
    if scheme is not None:
        recipe.scheme = scheme
    return recipe

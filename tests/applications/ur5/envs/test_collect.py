"""Demos are the expert's episodes; kills, processes and damage leave a collection byte for byte as it would be."""

import shutil

import numpy as np
import pytest
import torch

from tests.envs.opengl import needs_opengl
from torch_denkf.applications.ur5 import UR5ExperienceReplay, UR5TableEnv
from torch_denkf.applications.ur5.commands.collect_ur5 import CollectUR5
from torch_denkf.applications.ur5.data.files import COLLECTION, MANIFEST, read_demo, read_manifest
from torch_denkf.applications.ur5.envs import episodes
from torch_denkf.applications.ur5.envs.collect import LOCK, collect_ur5_demos
from torch_denkf.applications.ur5.envs.expert import UR5Expert

BLIND = {"frames": None, "seed": 3}
DEMOS = 3


def content(root):
    return {file.name: file.read_bytes() for file in root.iterdir() if file.name != LOCK}


def demos_of(root):
    return [read_demo(root, entry) for entry in read_manifest(root).values()]


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    """Collects three demos in this process, without images."""
    root = tmp_path_factory.mktemp("unbroken")
    counts = []
    assert collect_ur5_demos(root, DEMOS, **BLIND, progress=counts.append) == DEMOS
    assert counts == [0, *[1] * DEMOS]
    assert sorted(content(root)) == [COLLECTION, *(f"demo-{k:06d}.npz" for k in range(DEMOS)), MANIFEST]
    return root


@pytest.fixture
def copy(unbroken, tmp_path):
    return shutil.copytree(unbroken, tmp_path / "copy")


def test_demos_are_the_experts_episodes(unbroken):
    demos = demos_of(unbroken)
    assert [demo.task for demo in demos] == ["pick", "push", "put_down"]
    assert len({demo.seed for demo in demos}) == DEMOS
    for demo in demos:  # by an environment of its own, which has not seen the others
        env = UR5TableEnv(demo.task, from_pixels=False)
        env.set_seed(demo.seed)
        rollout = env.rollout(350, UR5Expert(env))
        assert rollout["next", "success"][-1]
        for key in ("state", "action"):
            assert (rollout[key].numpy() == getattr(demo, key)).all()
        assert (rollout["success"].squeeze(-1).numpy() == demo.success).all()
        assert demo.pixels.shape == (0, 3, 224, 224)


@pytest.mark.parametrize("domain", ["sim", pytest.param("real_like", marks=pytest.mark.slow)])
def test_demos_do_not_follow_from_those_before_them(domain):
    """Seed 0, demo 4: with the fingers left where demo 1's episode ended, 600 of its states came out otherwise."""
    options = episodes.Options((8, 8), None, domain, ("pick", "push", "put_down"), 0, 350, 0.0)
    for number in (1, 2):
        episodes._episode(options, number, 0)
    later = [vars(episodes._episode(options, number, 0)) for number in (4, 5)]
    for number, demo in zip((4, 5), later, strict=True):
        episodes._close()
        alone = vars(episodes._episode(options, number, 0))
        for key, value in demo.items():
            assert np.array_equal(value, alone[key]), key
    episodes._close()


@pytest.mark.parametrize("domain", ["sim", "real_like"])
def test_pictures_are_of_their_steps(tmp_path, domain):
    needs_opengl()
    options = {"size": (16, 20), "domain": domain, "tasks": ["push"], "noise": 0.005, "seed": 1}
    collect_ur5_demos(tmp_path, 2, frames=4, max_steps=30, **options)
    for demo in demos_of(tmp_path):
        assert demo.domain == domain
        assert len(set(demo.steps.tolist())) == 4
        assert demo.pixels.shape == (4, 3, 16, 20)
        env = UR5TableEnv("push", domain, size=(16, 20), pixels_dtype=torch.uint8, render_at=demo.steps.tolist())
        env.set_seed(demo.seed)
        row = env.reset()
        pictures = []
        for step in range(30):
            assert (row["state"].numpy() == demo.state[step]).all()
            if row["observed"]:
                pictures.append(row["pixels"].numpy())
            noise = demo.action[step] - row["expert", "action"].numpy()
            assert noise[6] == 0
            assert 0 < np.abs(noise[:6]).max() < 0.03  # six standard deviations
            row = env.step(row.set("action", torch.from_numpy(demo.action[step])))["next"]
        assert (np.stack(pictures) == demo.pixels).all()
        env.close()
    data = UR5ExperienceReplay(tmp_path, split="all", frames_only=True, cache=None)
    assert (data[:]["pixels"].numpy()[:4] == demos_of(tmp_path)[0].pixels.astype(np.float32) / 255).all()


def test_interrupted_run_resumes(unbroken, tmp_path):
    """``tests/deployment`` shows that workers end with a killed parent, and that a second process must wait."""
    made = []

    def stop(count):
        made.append(count)
        if sum(made) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        collect_ur5_demos(tmp_path, DEMOS, **BLIND, progress=stop)
    with (tmp_path / MANIFEST).open("a") as file:
        file.write('{"demo": 39, "file": "demo-0000')  # killed while writing the line
    stamp = (tmp_path / "demo-000000.npz").stat().st_mtime_ns
    collect_ur5_demos(tmp_path, DEMOS, **BLIND)
    assert (tmp_path / "demo-000000.npz").stat().st_mtime_ns == stamp  # not made again
    assert content(tmp_path) == content(unbroken)


@pytest.mark.parametrize("damage", ["cut", "changed", "missing"])
def test_damaged_files_are_found_and_made_again(unbroken, copy, capsys, damage):
    file = copy / "demo-000002.npz"
    data = bytearray(file.read_bytes())
    if damage == "missing":
        file.unlink()
    elif damage == "cut":
        file.write_bytes(data[:-10])
    else:
        data[100] ^= 1
        file.write_bytes(data)
    assert CollectUR5.main(["--out", str(copy), "--verify"]) == 1
    out, err = capsys.readouterr()
    assert out == f"3 demos in {copy}: 1 are missing, damaged or not listed\n"
    assert err.startswith(str(file))
    assert len(err.splitlines()) == 1
    with pytest.warns(UserWarning, match=f"{file}.*made again"):
        assert collect_ur5_demos(copy, DEMOS, **BLIND) == 1
    assert content(copy) == content(unbroken)
    assert CollectUR5.main(["--out", str(copy), "--verify"]) == 0
    assert capsys.readouterr().out == f"3 demos in {copy}: all checksums are right\n"

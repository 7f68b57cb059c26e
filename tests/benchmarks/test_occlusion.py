import torch

from benchmarks.occlusion.study import scores
from benchmarks.occlusion.task import HEIGHT, PILLAR, RADIUS, WIDTH, drawn, filter_of, runs


def test_the_ball_stays_in_its_box_and_is_seen_where_it_is():
    data = runs(20, 150, 0)
    place, visible = data["state"][..., :2], data["visible"].squeeze(-1)
    # A push behind the step may lead a little into a wall.
    assert (place > RADIUS - 0.3).all()
    assert (place < torch.tensor([WIDTH, HEIGHT]) - RADIUS + 0.3).all()
    for value, brightest in ((1.0, 190), (0.0, 180)):
        rows, times = (visible[:, 60] == value).nonzero().squeeze(-1), 60
        pictures = drawn(data["state"][rows, times], 0)[:, 0].float()
        assert ((pictures.amax((1, 2)) > brightest) == bool(value)).all()
        if value:  # the bright pixels lie around the ball
            weight = (pictures > 180).float()
            x = (weight.sum(1) * torch.arange(WIDTH)).sum(-1) / weight.sum((1, 2))
            assert (x - place[rows, times, 0]).abs().max() < 0.6
    partly = visible.isnan()
    x = place[..., 0]
    assert (((x - PILLAR[0]).abs() < RADIUS) | ((x - PILLAR[1]).abs() < RADIUS) | ~partly).all()


def test_filters_that_know_of_the_camera_find_the_ball_behind_the_pillar():
    """A camera that reads the middle of the pillar there, and an encoding that tells: heads that know, by hand."""
    data = runs(20, 100, 2)
    sees = data["visible"] == 1
    noise = torch.randn(20, 100, 2, generator=torch.Generator().manual_seed(0))
    data["reading"] = torch.where(sees, data["state"][..., :2], torch.tensor([32.0, 24.0])) + 0.5 * noise
    data["encoding"] = sees.float().expand(-1, -1, 32).clone()
    errors = []
    for visibility in (False, True):
        filter = filter_of("EKF", visibility=visibility)
        if visibility:
            layers = filter["visibility"].module.layers
            layers[0].weight.data.fill_(1 / 32)
            layers[0].bias.data.fill_(0)
            layers[-1].weight.data.fill_(20 / 32)
            layers[-1].bias.data.fill_(-10)
        with torch.no_grad():
            out = filter.sequence(data.clone())
        errors.append(scores(out["belief", "mean"][..., :2], out["belief", "var"][..., :2], data)["error_hidden"])
    assert errors[1] < 0.5 * errors[0]

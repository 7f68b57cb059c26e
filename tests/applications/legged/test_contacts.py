import torch

from torch_denkf.applications.legged import contacts


def test_noise_between_two_thresholds_changes_nothing():
    torch.manual_seed(0)
    force = torch.tensor([0.0, 0.0, 80.0, 50.0, 50.0, 10.0, 50.0, 50.0]).repeat_interleave(5)
    noisy = (force + 4 * torch.randn(3, 2, 40)).transpose(-1, -2)
    expected = torch.tensor([0, 0, 1, 1, 1, 0, 0, 0]).bool().repeat_interleave(5)
    assert torch.equal(contacts(noisy, 65.0, 35.0), expected.view(1, 40, 1).expand(3, 40, 2))


def test_rows_one_by_one_are_all_at_once():
    torch.manual_seed(0)
    force = 100 * torch.rand(4, 30, 2)
    before, rows = None, []
    for row in range(30):
        rows.append(contacts(force[:, row : row + 1], 60.0, before=before))
        before = rows[-1][:, 0]
    assert torch.equal(torch.cat(rows, 1), contacts(force, 60.0, 30.0))

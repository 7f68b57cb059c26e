"""Oracles: the discrete Lyapunov equation, the binomial distribution, the recursion written out."""

import torch

from torch_denkf.envs.linear import LinearGaussianEnv

F = torch.tensor([[0.9, 0.3], [-0.2, 0.7]])
H = torch.tensor([[1.0, 0.5], [0.0, 1.0], [1.0, -1.0]])


def make(**kwargs):
    return LinearGaussianEnv(F, H, [0.3, 0.5], [0.1, 0.2, 0.4], **kwargs)


def test_stationary_moments():
    # From the stationary distribution N(0, P), P = F P F' + Q; 20,000 independent rows.
    n = 20_000
    Q, R = torch.diag(torch.tensor([0.09, 0.25])), torch.diag(torch.tensor([0.01, 0.04, 0.16]))
    kron = torch.eye(4) - torch.kron(F, F)
    P = torch.linalg.solve(kron, Q.flatten()).reshape(2, 2)
    torch.testing.assert_close(F @ P @ F.mT + Q, P)
    last = make(batch_size=[n], max_steps=1000).rollout(60)["next"][:, -1]  # 0.85^60 = 6e-5 of the start is left

    def close(samples, covariance):
        """Sample covariances have variance (C_ii C_jj + C_ij^2) / n."""
        sample = samples.mT @ samples / n
        diagonal = covariance.diagonal()
        error = ((diagonal.outer(diagonal) + covariance**2) / n).sqrt()
        assert ((sample - covariance).abs() < 5 * error).all()
        assert (samples.mean(0).abs() < 5 * (diagonal / n).sqrt()).all()

    close(last["state"], P)
    close(last["observation"], H @ P @ H.mT + R)
    close(last["observation"] - last["state"] @ H.mT, R)


def test_transition_and_control_without_noise():
    control = torch.tensor([[1.0], [-2.0]])
    env = LinearGaussianEnv(F, H, [0.0, 0.0], [0.0] * 3, control=control, batch_size=[3])
    rollout = env.rollout(6)
    state, action = rollout["state"], rollout["action"]
    torch.testing.assert_close(rollout["next", "state"], state @ F.mT + action @ control.mT)
    torch.testing.assert_close(rollout["observation"], state @ H.mT)
    assert rollout["next", "state"][:, :-1].equal(state[:, 1:])


def test_seeds():
    def run(set_seed=None, **kwargs):
        env = make(batch_size=[2], missing=0.3, **kwargs)
        if set_seed is not None:
            env.set_seed(set_seed)
        torch.manual_seed(0)  # of the random actions
        return env.rollout(5)["next", "state"]

    assert run(1).equal(run(1))
    assert not run(1).equal(run(2))
    assert run(seed=3).equal(run(seed=3))
    assert not run(seed=3).equal(run(seed=4))
    state = torch.get_rng_state()
    make().reset()
    assert torch.get_rng_state().equal(state), "its own generator"

"""Laws of the denoising processes."""

import pytest
import torch as th

from sb3_policyflow.flows.denoising import DDPM, EulerChain, cosine_alpha_bar
from sb3_policyflow.flows.solvers import integrate


@pytest.mark.parametrize("n_steps", [1, 2, 10, 50])
def test_share_of_the_data_rises_to_one(n_steps: int) -> None:
    retained = cosine_alpha_bar(n_steps)
    assert retained.shape == (n_steps + 1,)
    assert (retained.diff() > 0).all()
    assert retained[-1].item() == 1.0
    assert (retained[:-1] / retained[1:]).min().item() >= 0.001 - 1e-12


@pytest.mark.parametrize("n_steps", [1, 5, 20])
def test_a_step_is_the_posterior_of_the_forward_process(n_steps: int) -> None:
    """Bayes' rule for x_{k+1} given x_k and the data, with precisions added up by hand."""
    process = DDPM(n_steps, data_clip=10.0, identity_skip=False)
    retained = cosine_alpha_bar(n_steps)
    for step in range(n_steps - 1):
        before, after = retained[step], retained[step + 1]
        alpha = before / after
        data, point = th.tensor([0.7]).double(), th.tensor([-0.4]).double()
        # x_{k+1} | data ~ N(sqrt(after) data, 1 - after);  x_k | x_{k+1} ~ N(sqrt(alpha) x_{k+1},
        # 1 - alpha)
        precision = 1 / (1 - after) + alpha / (1 - alpha)
        mean = (after.sqrt() * data / (1 - after) + alpha.sqrt() * point / (1 - alpha)) / precision
        noise = (point - before.sqrt() * data) / (1 - before).sqrt()
        result = process.means(point.float(), noise.float(), step)
        th.testing.assert_close(result.double(), mean, atol=1e-4, rtol=1e-4)
        assert process.stds[step].item() == pytest.approx(precision.item() ** -0.5, rel=1e-4)


def test_predicted_data_are_clipped_and_the_last_step_ends_at_them() -> None:
    process = DDPM(5, identity_skip=False)
    points = th.tensor([[3.0, -3.0]])
    ends = process.means(points, th.zeros_like(points), 4)
    th.testing.assert_close(ends, th.tensor([[1.0, -1.0]]))


def test_identity_skip_adds_the_point_to_the_noise() -> None:
    points, outputs = th.randn(7, 2), th.randn(7, 2)
    skipping, plain = DDPM(5), DDPM(5, identity_skip=False)
    for step in range(5):
        th.testing.assert_close(
            skipping.means(points, outputs, step), plain.means(points, outputs + points, step)
        )


@pytest.mark.parametrize("process", [DDPM(4), EulerChain(4)])
def test_several_steps_at_once_are_those_steps(process: DDPM | EulerChain) -> None:
    points, outputs = th.randn(7, 3, 2), th.randn(7, 3, 2)
    together = process.means(points, outputs, slice(1, None))
    for i in range(3):
        th.testing.assert_close(together[:, i], process.means(points[:, i], outputs[:, i], i + 1))


def test_euler_chain_without_noise_integrates_the_flow() -> None:
    process, start = EulerChain(8), th.randn(5, 2)
    points = start
    for step in range(8):
        points = process.means(points, points.sin() + process.times[step], step)
    expected = integrate(lambda x, t: x.sin() + t, start, n_steps=8, solver="euler")
    th.testing.assert_close(points, expected)
    assert process.stds.tolist() == [0.0] * 8


def test_a_chain_has_steps() -> None:
    with pytest.raises(ValueError, match="at least one step"):
        EulerChain(0)


def test_constants_are_not_saved() -> None:
    assert DDPM(4).state_dict() == {}

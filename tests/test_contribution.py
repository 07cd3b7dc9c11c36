import torch

from sadgs_ns.contribution import most_pixels
from scenes import camera, random_params

from sadgs_ns.splatter import rasterization


def test_a_contribution_is_the_image_s_change_when_a_gaussians_colour_changes():
    """By differences of whole renderings: colours enter linearly."""
    params = random_params(6)
    viewmat, K = (value[0] for value in camera()[:2])
    shifted = viewmat.clone()
    shifted[0, 3] += 0.3
    found = most_pixels(params, [(viewmat, K, 64, 48), (shifted, K, 64, 48)])
    expected = torch.zeros(6)
    for view in (viewmat, shifted):
        for i in range(6):
            colors = torch.zeros(6, 1)
            colors[i] = 1.0
            renders, _, _ = rasterization(
                params["means"], params["quats"], params["scales"].exp(), params["opacities"].flatten().sigmoid(),
                colors, view[None], K[None], 64, 48, packed=False,
            )  # fmt: skip
            expected[i] = torch.maximum(expected[i], renders.sum().detach())
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
    assert (found > 0).any()


def test_a_gaussian_behind_the_camera_contributes_nothing():
    params = random_params(3)
    viewmat, K = (value[0] for value in camera()[:2])
    with torch.no_grad():
        params["means"][1] = -10 * viewmat[2, :3] - viewmat[:3, :3].T @ viewmat[:3, 3]
    assert most_pixels(params, [(viewmat, K, 64, 48)])[1] == 0

"""Theorems about the seamless cubemap lookup, for the definition in torch and for the Numba kernel."""

import itertools
import math
from inspect import unwrap

import pytest
import torch

from panoless.kernels.cubemap import (
    apply_gram,
    cubemap_directions,
    cubemap_solid_angles,
    lookup_gram,
    sample_cubemap,
    scatter_cubemap,
    weigh_cubemap,
)
from panoless.kernels.reference.cubemap import project_to_face

# The definition is held to rounding in float64; the kernel computes positions in float32, which at L = 16 leaves
# weights good to about 1e-6 of a texel difference.
IMPLEMENTATIONS = [("reference", torch.float64, 1e-12), ("cpu", torch.float32, 5e-6)]
every_implementation = pytest.mark.parametrize(("backend", "dtype", "tolerance"), IMPLEMENTATIONS)
RESOLUTIONS = (1, 2, 5, 16)
EDGES = [(axes, signs) for axes in ((0, 1), (0, 2), (1, 2)) for signs in itertools.product((-1.0, 1.0), repeat=2)]


def random_cubemap(resolution, dtype=torch.float64, channels=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(6, channels, resolution, resolution, generator=generator, dtype=torch.float64).to(dtype)


def hard_directions(dtype=torch.float64, count=2000, seed=1):
    """Random directions of any length, then points on and within a hair of every edge and corner, and the axes."""
    generator = torch.Generator().manual_seed(seed)
    anywhere = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    along = torch.linspace(-1, 1, 41, dtype=torch.float64)
    edges = torch.cat([edge_points(axes, signs, along) for axes, signs in EDGES])
    corners = torch.tensor(list(itertools.product((-1.0, 1.0), repeat=3)), dtype=torch.float64)
    nearly = torch.cat([edges, corners.repeat(20, 1)])
    nearly = nearly + 1e-3 * torch.randn(nearly.shape, generator=generator, dtype=torch.float64)
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    return torch.cat([anywhere, edges, corners, nearly, axes]).to(dtype)


def edge_points(axes, signs, along):
    """Points of one edge of the cube, as a function of the coordinate along it."""
    points = torch.empty(len(along), 3, dtype=torch.float64)
    points[:, axes[0]], points[:, axes[1]] = signs
    points[:, 3 - sum(axes)] = along
    return points


@every_implementation
@pytest.mark.parametrize("resolution", RESOLUTIONS)
def test_scatter_is_the_adjoint_of_the_lookup(backend, dtype, tolerance, resolution):
    cubemap, directions = random_cubemap(resolution, dtype), hard_directions(dtype)
    weights = torch.randn(len(directions), 3, generator=torch.Generator().manual_seed(2)).to(dtype)
    looked_up = sample_cubemap(cubemap, directions, backend=backend).double() * weights.double()
    scattered = scatter_cubemap(weights, directions, resolution, backend=backend).double() * cubemap.double()
    assert abs(looked_up.sum() - scattered.sum()) < tolerance * looked_up.abs().sum()


@every_implementation
@pytest.mark.parametrize("channels", [1, 3, 4, 6])
@pytest.mark.parametrize("weighted", [1, None])
def test_a_weighed_cubemap_is_looked_up_times_weights_and_scattered(backend, dtype, tolerance, channels, weighted):
    """In float64 by the definitions; three directions each, and more channels than lie together in the kernel."""
    cubemap, generator = random_cubemap(5, dtype, channels), torch.Generator().manual_seed(2)
    directions = torch.randn(1500, 3, 3, generator=generator, dtype=torch.float64).to(dtype)
    weights = torch.rand(1500, weighted or channels, generator=generator, dtype=torch.float64).to(dtype)
    exact = sample_cubemap(cubemap.double(), directions.double(), backend="reference") * weights.double()
    expected = scatter_cubemap(exact, directions.double(), 5, backend="reference")
    found = weigh_cubemap(cubemap, directions, weights, backend=backend)
    torch.testing.assert_close(found.double(), expected, atol=50 * tolerance, rtol=0)


@every_implementation
@pytest.mark.parametrize("resolution", RESOLUTIONS)
@pytest.mark.parametrize("channels", [1, 3, 6])
def test_the_matrix_of_lookups_weighs_a_cubemap(backend, dtype, tolerance, resolution, channels):
    """As looking up, weighing and scattering by the definitions in float64 does; on edges and corners, too."""
    cubemap, directions = random_cubemap(resolution, dtype, channels), hard_directions(dtype)
    directions = torch.cat([directions, directions.new_zeros(1, 3), directions.new_full((1, 3), math.nan)])
    weights = torch.rand(len(directions), generator=torch.Generator().manual_seed(2), dtype=torch.float64).to(dtype)
    exact = sample_cubemap(cubemap.double(), directions.double(), backend="reference") * weights.double()[:, None]
    expected = scatter_cubemap(exact, directions.double(), resolution, backend="reference")
    gram = lookup_gram(directions, weights, resolution, backend=backend)
    found = apply_gram(gram, cubemap, backend=backend)
    torch.testing.assert_close(found.double(), expected, atol=tolerance * float(expected.abs().max()), rtol=0)


@every_implementation
def test_matrices_of_lookups_add_up(backend, dtype, tolerance):
    """That of all rays is the sum of those of two parts, many rays a texel each, so that shares have rays of both."""
    directions = torch.randn(3000, 3, generator=torch.Generator().manual_seed(5)).to(dtype)
    weights = torch.rand(3000, generator=torch.Generator().manual_seed(2)).to(dtype)
    parts = [
        lookup_gram(directions[part], weights[part], 4, backend=backend) for part in (slice(700), slice(700, None))
    ]
    found = lookup_gram(directions, weights, 4, backend=backend)
    torch.testing.assert_close(found, parts[0] + parts[1], atol=20 * tolerance, rtol=0)
    assert torch.equal(found, lookup_gram(directions, weights, 4, backend=backend))


def test_the_matrix_of_lookups_refuses_what_does_not_match():
    with pytest.raises(ValueError, match="one direction"):
        unwrap(lookup_gram)(torch.zeros(2, 4, 3), torch.zeros(2), 4)
    with pytest.raises(ValueError, match="for this cubemap"):
        unwrap(apply_gram)(torch.zeros(6, 6, 6, 5), torch.zeros(6, 3, 5, 5))


@every_implementation
@pytest.mark.parametrize("samples", [1, 4, 700])
def test_several_directions_give_their_mean_and_its_adjoint_and_gradients(backend, dtype, tolerance, samples):
    """Against one lookup a direction, in float64; 700 are more than a block of the kernel holds."""
    directions = torch.randn(2100, 3, generator=torch.Generator().manual_seed(4)).to(dtype).reshape(-1, samples, 3)
    weights = torch.randn(len(directions), 3, generator=torch.Generator().manual_seed(3)).to(dtype)
    each, exact = directions.double().reshape(-1, 3).requires_grad_(), random_cubemap(5).requires_grad_()
    expected = sample_cubemap(exact, each, backend="reference").reshape(-1, samples, 3).mean(1)
    cubemap, joined = random_cubemap(5, dtype).requires_grad_(), directions.clone().requires_grad_()
    found = sample_cubemap(cubemap, joined, backend=backend)
    torch.testing.assert_close(found.double(), expected, atol=10 * tolerance, rtol=0)
    (expected * weights.double()).sum().backward()
    (found * weights).sum().backward()
    scattered = scatter_cubemap(weights, directions, 5, backend=backend)
    for pulled in (cubemap.grad, scattered):
        torch.testing.assert_close(pulled.double(), exact.grad, atol=100 * tolerance, rtol=0)
    torch.testing.assert_close(joined.grad.double().reshape(-1, 3), each.grad, atol=200 * tolerance, rtol=1e-4)


@every_implementation
@pytest.mark.parametrize("resolution", RESOLUTIONS)
def test_a_texel_center_returns_its_texel(backend, dtype, tolerance, resolution):
    cubemap = random_cubemap(resolution, dtype)
    directions = cubemap_directions(resolution, dtype=dtype).reshape(-1, 3)
    texels = cubemap.movedim(1, -1).reshape(-1, 3)
    # A texel center is a point, and rounding moves it: by 16·6e-8 of a texel at most, times a difference of about 6.
    torch.testing.assert_close(sample_cubemap(cubemap, directions, backend=backend), texels, rtol=0, atol=2 * tolerance)


@pytest.mark.parametrize("resolution", RESOLUTIONS)
def test_texel_directions_are_unit_and_project_back_to_their_texel(resolution):
    directions = cubemap_directions(resolution, dtype=torch.float64)
    face, st, usable = project_to_face(directions.reshape(-1, 3))
    position = ((st + 1) * resolution / 2 - 0.5).reshape(6, resolution, resolution, 2)
    index = torch.arange(resolution, dtype=torch.float64)
    assert usable.all()
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones_like(directions[..., 0]))
    assert (face.reshape(6, -1) == torch.arange(6)[:, None]).all()
    torch.testing.assert_close(position[..., 0], index.expand(6, resolution, resolution))
    torch.testing.assert_close(position[..., 1], index[:, None].expand(6, resolution, resolution))


def test_faces_are_oriented_as_the_opengl_table():
    # Table 8.19 by hand: one point a quarter to the right of the center of each face, and one a half below it.
    right = [[1, 0, -0.25], [-1, 0, 0.25], [0.25, 1, 0], [0.25, -1, 0], [0.25, 0, 1], [-0.25, 0, -1]]
    below = [[1, -0.5, 0], [-1, -0.5, 0], [0, 1, 0.5], [0, -1, -0.5], [0, -0.5, 1], [0, -0.5, -1]]
    face, st, _ = project_to_face(torch.tensor(right + below))
    assert face.tolist() == list(range(6)) * 2
    assert st.tolist() == [[0.25, 0]] * 6 + [[0, 0.5]] * 6


@every_implementation
@pytest.mark.parametrize(("axes", "signs"), EDGES)
def test_the_lookup_is_continuous_across_every_edge(backend, dtype, tolerance, axes, signs):
    cubemap, step = random_cubemap(8, dtype), 1e-5
    on_edge = edge_points(axes, signs, torch.linspace(-1, 1, 97, dtype=torch.float64))
    sides = []
    for axis in axes:
        beside = on_edge.clone()
        beside[:, axis] *= 1 + step
        sides.append(beside.to(dtype))
    first, second = (sample_cubemap(cubemap, side, backend=backend) for side in sides)
    # A step moves a point by at most step·L/2 texels in each coordinate, with texel differences of up to about 8.
    assert (first - second).abs().max() < 8 * 8 * step + tolerance
    faces = [project_to_face(side)[0] for side in sides]
    assert (faces[0] != faces[1])[1:-1].all()


@every_implementation
def test_a_corner_shows_the_mean_of_its_three_texels(backend, dtype, tolerance):
    resolution = 6
    cubemap = random_cubemap(resolution, dtype)
    directions = cubemap_directions(resolution, dtype=torch.float64)
    for signs in itertools.product((-1.0, 1.0), repeat=3):
        corner = torch.tensor([signs], dtype=torch.float64)
        nearest = (directions @ corner[0]).reshape(-1).topk(3).indices
        expected = cubemap.movedim(1, -1).reshape(-1, 3)[nearest].mean(0)
        found = sample_cubemap(cubemap, corner.to(dtype), backend=backend)[0]
        torch.testing.assert_close(found, expected, rtol=0, atol=tolerance)


@every_implementation
@pytest.mark.parametrize("resolution", [8, 32])
def test_a_linear_function_of_direction_is_reproduced_to_second_order(backend, dtype, tolerance, resolution):
    slope = torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64)
    cubemap = (cubemap_directions(resolution, dtype=torch.float64) @ slope)[:, None].to(dtype)
    directions = torch.nn.functional.normalize(hard_directions(), dim=-1)
    found = sample_cubemap(cubemap, directions.to(dtype), backend=backend)[:, 0].double()
    # Along a face the function changes with curvature of at most |slope| ≈ 1 in s and in t, so bilinear interpolation
    # over a cell of h = 2/L errs by at most 2·h²/8 (measured 0.23 h²). Across an edge a padded texel lies aside of the
    # place where the weights take it to be, which costs an order: measured 0.11 h, mostly at the corners.
    cell = 2 / resolution
    error = (found - directions @ slope).abs()
    assert error.max() < 0.15 * cell
    inner = project_to_face(directions)[1].abs().amax(-1) < 1 - cell / 2
    assert error[inner].max() < 2 * cell**2 / 8 + tolerance


def test_a_constant_cubemap_is_constant_and_its_weights_sum_to_one():
    directions = hard_directions()
    ones = torch.ones(6, 1, 7, 7, dtype=torch.float64)
    torch.testing.assert_close(sample_cubemap(ones, directions), torch.ones(len(directions), 1).double())
    total = scatter_cubemap(torch.ones(len(directions), 1).double(), directions, 7).sum()
    torch.testing.assert_close(total, torch.tensor(float(len(directions))).double())


@every_implementation
def test_rotating_the_world_about_z_permutes_the_texels(backend, dtype, tolerance):
    resolution = 5
    turn = torch.tensor([[0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=dtype)
    cubemap, directions = random_cubemap(resolution, dtype), hard_directions(dtype)
    # Texel d of the turned world shows what texel turnᵀ·d showed; both are texel centers, so this only permutes.
    centers = cubemap_directions(resolution, dtype=dtype).reshape(-1, 3)
    turned = sample_cubemap(cubemap, centers @ turn, backend=backend)
    turned = turned.reshape(6, resolution, resolution, 3).movedim(-1, 1)
    assert sorted(turned.flatten().tolist()) == pytest.approx(sorted(cubemap.flatten().tolist()), abs=4 * tolerance)
    torch.testing.assert_close(
        sample_cubemap(turned, directions @ turn.T, backend=backend),
        sample_cubemap(cubemap, directions, backend=backend),
        rtol=0,
        atol=4 * tolerance,
    )


@every_implementation
def test_the_length_of_a_direction_does_not_matter(backend, dtype, tolerance):
    cubemap, directions = random_cubemap(9, dtype), hard_directions(dtype)
    expected = sample_cubemap(cubemap, directions, backend=backend)
    for scale in (1e-20, 1e-3, 1e3, 1e30):
        found = sample_cubemap(cubemap, directions * scale, backend=backend)
        torch.testing.assert_close(found, expected, rtol=0, atol=4 * tolerance)


@every_implementation
def test_directions_that_look_nowhere_give_zero_and_pass_no_gradient(backend, dtype, tolerance):
    nan, inf = float("nan"), float("inf")
    directions = torch.tensor(
        [[0, 0, 0], [nan, 1, 1], [1, 1, nan], [inf, 0, 0], [1, -inf, 2], [1e-42, 0, 0]], dtype=dtype
    )
    cubemap = random_cubemap(4, dtype).requires_grad_()
    directions.requires_grad_()
    values = sample_cubemap(cubemap, directions, backend=backend)
    values.sum().backward()
    assert (values == 0).all()
    assert (cubemap.grad == 0).all()
    assert (directions.grad == 0).all()
    assert (scatter_cubemap(torch.ones(6, 3, dtype=dtype), directions, 4, backend=backend) == 0).all()


def test_gradcheck_of_the_definition():
    cubemap = random_cubemap(3, channels=2).requires_grad_()
    directions = torch.randn(40, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    _, st, _ = project_to_face(directions)
    position = (st + 1) * 3 / 2 - 0.5
    # The derivative jumps on the lines between cells and on edges of the cube; finite differences must not cross them.
    smooth = ((position - position.round()).abs().amin(-1) > 1e-3) & (st.abs().amax(-1) < 1 - 1e-3)
    directions = directions[smooth].requires_grad_()
    assert len(directions) > 30
    assert torch.autograd.gradcheck(sample_cubemap, (cubemap, directions))


@pytest.mark.parametrize(("resolution", "channels"), [(1, 3), (2, 1), (5, 4), (33, 3)])
def test_the_kernel_pulls_back_as_the_definition(resolution, channels):
    directions = hard_directions(torch.float32)
    # Exactly on a line between cells either side's derivative is right, and rounding chooses; keep off those lines.
    _, st, _ = project_to_face(directions.double())
    position = (st + 1) * resolution / 2 - 0.5
    away = ((position - position.round()).abs().amin(-1) > 1e-5) & (st.abs().amax(-1) < 1 - 1e-6)
    directions = directions[away]
    assert len(directions) > 2000
    cotangent = torch.randn(len(directions), channels, generator=torch.Generator().manual_seed(4))
    results = {}
    for backend, dtype in (("reference", torch.float64), ("cpu", torch.float32)):
        cubemap = random_cubemap(resolution, torch.float32, channels).to(dtype).requires_grad_()
        inputs = directions.to(dtype).requires_grad_()
        values = sample_cubemap(cubemap, inputs, backend=backend)
        values.backward(cotangent.to(dtype))
        results[backend] = (values, cubemap.grad, inputs.grad)
    for expected, found in zip(results["reference"], results["cpu"], strict=True):
        # Measured: 1.4e-6 of the largest entry at L = 33, from positions in float32.
        assert (found - expected).abs().max() < 1e-5 * expected.abs().max()


def test_each_gradient_can_be_asked_for_alone_and_outlives_another_lookup():
    directions = hard_directions(torch.float32)
    cubemap, other = random_cubemap(8, torch.float32), random_cubemap(8, torch.float32, seed=9)
    both_cubemap, both_directions = cubemap.clone().requires_grad_(), directions.clone().requires_grad_()
    sample_cubemap(both_cubemap, both_directions, backend="cpu").sum().backward()
    only_cubemap, only_directions = cubemap.clone().requires_grad_(), directions.clone().requires_grad_()
    first = sample_cubemap(only_cubemap, directions, backend="cpu")
    second = sample_cubemap(cubemap, only_directions, backend="cpu")
    sample_cubemap(other.requires_grad_(), directions.flip(0), backend="cpu").sum().backward()
    (first.sum() + second.sum()).backward()
    assert torch.equal(only_cubemap.grad, both_cubemap.grad)
    assert torch.equal(only_directions.grad, both_directions.grad)


@every_implementation
def test_no_directions_are_fine(backend, dtype, tolerance):
    cubemap, none = random_cubemap(4, dtype).requires_grad_(), torch.empty(0, 3, dtype=dtype)
    values = sample_cubemap(cubemap, none, backend=backend)
    values.sum().backward()
    assert values.shape == (0, 3)
    assert (cubemap.grad == 0).all()


def test_scattering_is_repeatable_to_the_bit():
    directions, values = hard_directions(torch.float32), torch.randn(10_000, 3)
    values = values[: len(directions)]
    first = scatter_cubemap(values, directions, 4, backend="cpu")
    assert all(torch.equal(first, scatter_cubemap(values, directions, 4, backend="cpu")) for _ in range(5))


@pytest.mark.parametrize("resolution", [1, 2, 7, 128])
def test_solid_angles_sum_to_the_sphere(resolution):
    angles = cubemap_solid_angles(resolution, dtype=torch.float64)
    assert 6 * angles.sum().item() == pytest.approx(4 * math.pi, rel=1e-12)
    assert (angles > 0).all()
    torch.testing.assert_close(angles, angles.T)
    torch.testing.assert_close(angles, angles.flip(0))


def test_solid_angles_agree_with_the_jacobian_of_the_projection():
    # dΩ = ds dt (1 + s² + t²)^(−3/2); the midpoint rule is good to h²·f″/24 ≈ 1e-4 of a texel at L = 64.
    centers = 2 * (torch.arange(64, dtype=torch.float64) + 0.5) / 64 - 1
    midpoint = (2 / 64) ** 2 * (1 + centers[:, None] ** 2 + centers**2) ** -1.5
    torch.testing.assert_close(cubemap_solid_angles(64, dtype=torch.float64), midpoint, rtol=3e-4, atol=0)


@pytest.mark.parametrize(
    ("cubemap", "directions", "options"),
    [
        (torch.zeros(5, 3, 4, 4), torch.zeros(2, 3), {}),
        (torch.zeros(6, 3, 4, 5), torch.zeros(2, 3), {}),
        (torch.zeros(6, 3, 4, 4), torch.zeros(2, 2), {}),
        (torch.zeros(6, 3, 4, 4), torch.zeros(2, 3, dtype=torch.float64), {}),
        (torch.zeros(6, 3, 4, 4).double(), torch.zeros(2, 3).double(), {"backend": "cpu"}),
        (torch.zeros(6, 3, 4, 4), torch.zeros(2, 3), {"backend": "cuda"}),
    ],
)
def test_wrong_inputs_are_named(cubemap, directions, options):
    with pytest.raises(ValueError, match=r"expected .*; found "):
        # While testing, annotations are checked before the function runs; users meet what is inside.
        unwrap(sample_cubemap)(cubemap, directions, **options)


def test_scattering_refuses_values_that_do_not_match():
    with pytest.raises(ValueError, match="one row for each of the 2 directions"):
        unwrap(scatter_cubemap)(torch.zeros(3, 3), torch.zeros(2, 3), 4)
    with pytest.raises(ValueError, match="at least one texel"):
        unwrap(scatter_cubemap)(torch.zeros(2, 3), torch.zeros(2, 3), 0)

"""Conjugate gradients: exact after as many steps as unknowns, closer with every one before."""

import torch

from panoless.numeric.conjugate_gradients import conjugate_gradients

SHAPE = (6, 1, 1, 1)


def system() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    root, solution, start = (torch.randn(shape, generator=generator).double() for shape in ((6, 6), SHAPE, SHAPE))
    return root @ root.T + 0.1 * torch.eye(6), solution, start


def test_the_error_falls_and_ends_at_zero() -> None:
    """In the norm of A, with the inverse of its diagonal as a preconditioner."""
    matrix, solution, start = system()

    def product(image: torch.Tensor) -> torch.Tensor:
        return (matrix @ image.flatten()).view(SHAPE)

    energies = []
    for steps in range(7):
        result = conjugate_gradients(
            product, start, product(solution - start), (1 / matrix.diagonal()).view(SHAPE), steps
        )
        error = result - solution
        energies.append(float((error * product(error)).sum()))
    assert energies == sorted(energies, reverse=True)
    assert energies[-1] < 1e-12 * energies[0]


def test_the_start_and_the_residual_stay_as_they_are() -> None:
    _, solution, start = system()
    residual = solution - start
    kept = start.clone(), residual.clone()
    result = conjugate_gradients(lambda image: image, start, residual, torch.ones(SHAPE, dtype=torch.double), 1)
    torch.testing.assert_close(result, solution)
    assert torch.equal(start, kept[0])
    assert torch.equal(residual, kept[1])

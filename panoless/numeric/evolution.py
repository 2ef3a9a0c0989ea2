"""Minimization without derivatives by covariance matrix adaptation (Hansen and Ostermeier 2001)."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float


def evolve(
    cost: Callable[[Float[np.ndarray, "N"]], float],
    start: Float[np.ndarray, "N"],
    scales: Float[np.ndarray, "N"],
    evaluations: int,
    seed: int = 0,
) -> tuple[Float[np.ndarray, "N"], float]:
    """The best point seen within about so many evaluations, and its cost: never more than that of the start.

    Points are drawn about a mean that follows the better half of them, with a covariance that follows their steps;
    `scales` are the first standard deviations. Constants are those of Hansen's tutorial (arXiv 1604.00772), without
    the active update. Points are drawn by the symmetric root of the covariance, which does not depend on the signs and
    the order of its axes: so the same seed gives the same points on every machine, but for rounding.
    """
    rng, count = np.random.default_rng(seed), len(start)
    drawn = 4 + int(3 * np.log(count))
    kept = drawn // 2
    weights = np.log(kept + 0.5) - np.log(np.arange(1, kept + 1))
    weights /= weights.sum()
    mass = 1 / float((weights**2).sum())
    path_rate, sigma_rate = (4 + mass / count) / (count + 4 + 2 * mass / count), (mass + 2) / (count + mass + 5)
    rank_one = 2 / ((count + 1.3) ** 2 + mass)
    rank_many = min(1 - rank_one, 2 * (mass - 2 + 1 / mass) / ((count + 2) ** 2 + mass))
    sigma_damping = 1 + 2 * max(0.0, np.sqrt((mass - 1) / (count + 1)) - 1) + sigma_rate
    expected = np.sqrt(count) * (1 - 1 / (4 * count) + 1 / (21 * count**2))
    mean, sigma, covariance = np.zeros(count), 1.0, np.eye(count)
    path, sigma_path = np.zeros(count), np.zeros(count)
    best, least = start.copy(), cost(start)
    for _ in range(max(evaluations // drawn, 0)):
        variances, axes = np.linalg.eigh(covariance)
        lengths = np.sqrt(np.maximum(variances, 1e-14))
        steps = rng.normal(size=(drawn, count)) @ (axes * lengths @ axes.T)
        costs = np.array([cost(start + scales * (mean + sigma * step)) for step in steps])
        order = np.argsort(costs, kind="stable")
        if costs[order[0]] < least:
            best, least = start + scales * (mean + sigma * steps[order[0]]), float(costs[order[0]])
        chosen = steps[order[:kept]]
        moved = weights @ chosen
        mean = mean + sigma * moved
        whitened = axes @ ((axes.T @ moved) / lengths)
        sigma_path = (1 - sigma_rate) * sigma_path + np.sqrt(sigma_rate * (2 - sigma_rate) * mass) * whitened
        path = (1 - path_rate) * path + np.sqrt(path_rate * (2 - path_rate) * mass) * moved
        spread = np.einsum("k,ki,kj->ij", weights, chosen, chosen)
        covariance = (1 - rank_one - rank_many) * covariance + rank_one * np.outer(path, path) + rank_many * spread
        sigma *= float(np.exp(sigma_rate / sigma_damping * (np.linalg.norm(sigma_path) / expected - 1)))
    return best, least

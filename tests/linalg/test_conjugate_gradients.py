"""Conjugate gradients whose residuals are kept orthogonal."""

import pytest
import torch
from laws import random_like

from phydict.linalg.conjugate_gradients import conjugate_gradients, most_kept

SIZE = 200
EIGENVALUES = torch.logspace(0, 5, SIZE).double()
RIGHT = random_like((2, 1, 4, 5, 10), seed=1)
SCALE = 1 / (EIGENVALUES.sqrt() * (1 + random_like((SIZE,), seed=2).abs())).view(1, 1, 4, 5, 10)


def solved(dtype: torch.dtype, iterations: int, reorthogonalise: bool, right=RIGHT) -> torch.Tensor:
    turn = torch.linalg.qr(random_like((SIZE, SIZE), seed=3))[0]
    matrix = (turn * EIGENVALUES) @ turn.T

    def operator(d):
        return (d.flatten(1) @ matrix.to(dtype)).view_as(d)

    return conjugate_gradients(operator, right.to(dtype), iterations, 0.0, SCALE.to(dtype),
                               reorthogonalise=reorthogonalise)


@pytest.mark.parametrize("iterations", [30, 60])
def test_kept_orthogonal_single_precision_goes_where_double_goes(iterations):
    exact = solved(torch.float64, iterations, True)
    kept, lost = ((solved(torch.float32, iterations, keep).double() - exact).norm() / exact.norm()
                  for keep in (True, False))
    assert kept < 1e-3 and lost > 10 * kept


def test_in_double_precision_few_iterations_are_the_same_and_a_solved_case_stays():
    torch.testing.assert_close(solved(torch.float64, 8, True), solved(torch.float64, 8, False), rtol=1e-8, atol=0)
    half = torch.cat([RIGHT[:1], torch.zeros_like(RIGHT[:1])])
    found = solved(torch.float64, 20, True, half)
    torch.testing.assert_close(found[:1], solved(torch.float64, 20, True)[:1])
    assert not found[1].any()


def test_iterations_are_a_bound_for_which_no_memory_is_kept():
    """10^10 residuals were 32 TB."""
    def stop():
        raise InterruptedError

    with pytest.raises(InterruptedError):
        conjugate_gradients(lambda d: SCALE * d, RIGHT, 10**10, on_step=stop, reorthogonalise=True)


def test_more_room_for_residuals_changes_no_bit(monkeypatch):
    plain = solved(torch.float32, 60, True)
    monkeypatch.setattr("phydict.linalg.conjugate_gradients.KEPT", 3)
    assert torch.equal(solved(torch.float32, 60, True), plain)


@pytest.mark.parametrize("iterations, doubled", [(3, False), (4, True), (10, True)])
def test_the_most_residuals_that_are_held_are_both_rooms_while_the_second_is_made(monkeypatch, iterations, doubled):
    monkeypatch.setattr("phydict.linalg.conjugate_gradients.KEPT", 3)
    held, cat = [3], torch.cat
    monkeypatch.setattr(torch, "cat", lambda parts: held.append(2 * sum(map(len, parts))) or cat(parts))
    solved(torch.float32, iterations, True)
    assert max(held) == most_kept(iterations) and (len(held) > 1) == doubled


def test_iterations_beyond_the_solution_change_nothing_without_a_tolerance():
    """Of six unknowns more than twelve kept residuals had made each further one larger, without an end."""
    rows = random_like((3, 6), seed=4)
    matrix = rows.T @ rows + 0.01 * torch.eye(6).double()
    right = random_like((1, 6), seed=5)
    found = conjugate_gradients(lambda d: d @ matrix, right, 400, 0.0, reorthogonalise=True)
    torch.testing.assert_close(found[0], torch.linalg.solve(matrix, right[0]), rtol=1e-9, atol=0)

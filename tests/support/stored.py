"""Storage of points in the folder `vectors` of a run."""

from mortarbench.harness.files.store import point_arrays, save


def save_solution(folder, solution):
    """Store a primal-dual point and its history; return the digest of both."""
    return save(folder, point_arrays(solution))

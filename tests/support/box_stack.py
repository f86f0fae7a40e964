"""Stacks of boxes on the ground as FCLIB problems: an impact step of rigid bodies."""

import h5py
import numpy as np

SIDE, MASS, GRAVITY_STEP = 0.2, 3.0, 9.81e-3


def write_datasets(path, arrays):
    """Write arrays to an HDF5 file, with their types and shapes."""
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array)


def box_stack(boxes=3, mu=0.4, seed=5):
    """Return M (6b,), H (6b, 12b), f (6b,) and μ (4b,) of b boxes.

    There are four contacts below each box. In addition to the velocity due to gravity,
    boxes have random tangential velocities and spins. The rank of W = HᵀM⁻¹H is half
    its order.
    """
    rng = np.random.default_rng(seed)
    inertia = MASS * SIDE**2 / 6
    M = np.tile([MASS] * 3 + [inertia] * 3, boxes)
    H = np.zeros((6 * boxes, 12 * boxes))
    axes = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])  # N, T₁, T₂
    corners = SIDE / 2 * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    for box in range(boxes):
        for c, (x, y) in enumerate(corners):
            columns = 12 * box + 3 * c + np.arange(3)
            for body, z, sign in ((box, -SIDE / 2, 1), (box - 1, SIDE / 2, -1)):
                if body >= 0:
                    arm = np.array([x, y, z])
                    rows = 6 * body + np.arange(6)
                    H[np.ix_(rows, columns)] = sign * np.vstack(
                        [axes.T, np.cross(arm, axes).T]
                    )
    v = np.zeros((boxes, 6))
    v[:, 2] = -GRAVITY_STEP
    v[:, :2] = GRAVITY_STEP * rng.uniform(-1, 1, (boxes, 2))
    v[:, 5] = 3 * GRAVITY_STEP * rng.uniform(-1, 1, boxes)
    return M, H, M * v.ravel(), np.full(4 * boxes, mu)


def local_arrays(W, q, mu, dim=3):
    """Return the arrays of a local problem, with W stored by rows as in many files."""
    i, j = np.nonzero(W)
    counts = np.bincount(i, minlength=len(W))
    sizes = dict(nzmax=i.size, m=len(W), n=len(W), nz=-2)
    arrays = {f"W/{key}": np.array([size], np.int32) for key, size in sizes.items()}
    arrays |= {
        "W/p": np.append(0, np.cumsum(counts)).astype(np.int32),
        "W/i": j.astype(np.int32), "W/x": W[i, j],
        "spacedim": np.array([dim], np.int32), "vectors/q": q, "vectors/mu": mu,
        "info/title": np.array(b"boxes"), "info/description": np.array(b"stack"),
        "info/math_info": np.array(b"unknown"),
    }  # fmt: skip
    return {f"fclib_local/{name}": array for name, array in arrays.items()}


def global_arrays(M, H, f, mu, *, rows_first=False):
    """Return the arrays of a global problem, with matrices as triplets.

    rows_first : True for the order in FCLIB's documentation (p contains rows), False
        for the order of CSparse (p contains columns)
    """
    arrays = {"spacedim": np.array([3], np.int32), "vectors/f": f, "vectors/mu": mu}
    arrays["vectors/w"] = np.zeros(H.shape[1])
    for name, matrix in (("M", np.diag(M)), ("H", H)):
        arrays |= triplets(name, matrix, rows_first=rows_first)
    return {f"fclib_global/{name}": array for name, array in arrays.items()}


def triplets(name, matrix, *, rows_first=False):
    """Return the arrays of a matrix as triplets, see `global_arrays`."""
    i, j = np.nonzero(matrix)
    sizes = dict(nzmax=i.size, m=len(matrix), n=matrix.shape[1], nz=i.size)
    arrays = {key: np.array([size], np.int32) for key, size in sizes.items()}
    arrays["p"], arrays["i"] = (
        v.astype(np.int32) for v in ((i, j) if rows_first else (j, i))
    )
    arrays["x"] = matrix[i, j]
    return {f"{name}/{key}": array for key, array in arrays.items()}


def write_boxes(path, boxes=3, mu=0.4, seed=5):
    """Write the local problem of a stack; return W, q and μ."""
    M, H, f, mu = box_stack(boxes, mu, seed)
    W, q = H.T @ (H / M[:, None]), H.T @ (f / M)
    W = (W + W.T) / 2
    write_datasets(path, local_arrays(W, q, mu))
    return W, q, mu

# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
# cython: initializedcheck=False
"""Compiled loops of nested dissection, see `problems.fem.dissection`."""

from libc.math cimport INFINITY, atan2, cos, fabs, fmax, fmin, sin
from libc.stdint cimport int64_t

import numpy as np

#: number of Jacobi sweeps for a 3 × 3 matrix; since convergence is quadratic, four
#: suffice for double precision
cdef int SWEEPS = 8
#: off-diagonal entries, and differences of eigenvalues, count as zero up to this
#: multiple of the trace
cdef double ROUNDING = 1e-9


def node_graph(const int[::1] indptr, const int[::1] indices, int d, int nodes):
    """Return the node graph (ptr, idx) of a matrix pattern with d components per node.

    A node is not its own neighbour.
    """
    cdef Py_ssize_t a, b, t, end = 0
    pointers = np.zeros(nodes + 1, dtype=np.int32)
    neighbours = np.empty(indices.shape[0], dtype=np.int32)
    cdef int[::1] ptr = pointers, idx = neighbours
    cdef int[::1] seen = np.full(nodes, -1, dtype=np.int32)
    for a in range(nodes):
        seen[a] = a
        for t in range(indptr[d * a], indptr[d * (a + 1)]):
            b = indices[t] // d
            if seen[b] != a:
                seen[b] = a
                idx[end] = b
                end += 1
        ptr[a + 1] = end
    return pointers, neighbours[:end].copy()


def components(const int[::1] ptr, const int[::1] idx):
    """Return the number of the connected component of each node, (N,).

    Components are numbered in the order of their first nodes.
    """
    cdef Py_ssize_t seed, t, at, end, nodes = ptr.shape[0] - 1
    cdef int count = 0
    numbers = np.full(nodes, -1, dtype=np.int32)
    cdef int[::1] number = numbers, queue = np.empty(nodes, dtype=np.int32)
    for seed in range(nodes):
        if number[seed] >= 0:
            continue
        number[seed], queue[0], at, end = count, seed, 0, 1
        while at < end:
            for t in range(ptr[queue[at]], ptr[queue[at] + 1]):
                if number[idx[t]] < 0:
                    number[idx[t]], queue[end] = count, idx[t]
                    end += 1
            at += 1
        count += 1
    return numbers


def dissect_components(
    const int[::1] ptr, const int[::1] idx, const double[:, :] points, is_last, int leaf
):
    """Dissect each connected component, see `dissect` and `Fronts`.

    Returns order (N,), start (F + 1,), children (F,) and roots (F,).
    """
    # order by component, then `is_last`, then node number
    key = 2 * components(ptr, idx) + is_last
    chosen = np.argsort(key, kind="stable").astype(np.int32)
    ends = np.append(0, np.bincount(key, minlength=key.max() // 2 * 2 + 2).cumsum())
    cdef int[::1] order = chosen
    cdef const int64_t[::1] end = ends

    # a part of n nodes is bisected at most n − 1 times, which bounds the array sizes
    cdef Py_ssize_t nodes = points.shape[0], depth, low, high, middle, separator
    cdef Py_ssize_t c, begin, fronts = 0
    lengths, branches = np.zeros((2, 3 * nodes), dtype=np.int32)
    roots = np.zeros(3 * nodes, dtype=np.bool_)
    cdef int[::1] length = lengths, children = branches
    cdef int[:, ::1] stack = np.empty((2 * nodes, 2), dtype=np.int32)
    # half of each node in the last bisection
    cdef int[::1] side = np.zeros(nodes, dtype=np.int32)
    cdef int[::1] kind = np.empty(nodes, dtype=np.int32), copy = np.empty_like(kind)
    cdef double[:, ::1] along = np.empty((2, nodes))
    cdef int cut = 0
    for c in range(end.shape[0] // 2):
        # reversed postorder: separator, second half, first half
        begin, depth = fronts, 0
        if end[2 * c] < end[2 * c + 1]:
            stack[0, 0], stack[0, 1], depth = end[2 * c], end[2 * c + 1], 1
        while depth:
            depth -= 1
            low, high = stack[depth, 0], stack[depth, 1]
            middle = separator = high
            if high - low > leaf:
                cut += 2
                bisect(
                    ptr, idx, points, order[low:high], side, cut, kind, copy, along,
                    &middle, &separator,
                )
                middle += low
                separator += low
            if middle != low and middle != high:
                length[fronts], children[fronts] = high - separator, 2
                stack[depth, 0], stack[depth, 1] = low, middle
                stack[depth + 1, 0], stack[depth + 1, 1] = middle, separator
                depth += 2
            else:  # a leaf, or all nodes have the same coordinate along the axis
                length[fronts], children[fronts] = high - low, 0
            fronts += 1
        lengths[begin:fronts] = lengths[begin:fronts][::-1].copy()
        branches[begin:fronts] = branches[begin:fronts][::-1].copy()
        length[fronts] = end[2 * c + 2] - end[2 * c + 1]
        children[fronts], roots[fronts] = fronts > begin, True
        fronts += 1
    start = np.append(0, np.cumsum(lengths[:fronts])).astype(np.int32)
    return chosen, start, branches[:fronts].copy(), roots[:fronts].copy()


cdef void bisect(
    const int[::1] ptr, const int[::1] idx, const double[:, :] points, int[::1] part,
    int[::1] side, int cut, int[::1] kind, int[::1] copy, double[:, ::1] along,
    Py_ssize_t *middle, Py_ssize_t *separator,
) noexcept:
    """Reorder `part` to first half, second half and separator.

    `middle` and `separator` are set to the offsets of the second half and of the
    separator, and `side` to `cut` on the first half and to cut + 1 on the other nodes.
    `kind`, `copy` and `along` (2, N) are workspace.
    """
    cdef Py_ssize_t a, t, s, n = part.shape[0]
    cdef double value, least = INFINITY, most = -INFINITY
    cdef Py_ssize_t[3] count = [0, 0, 0]
    coordinates(points, part, along[0])
    for t in range(n):
        along[1, t] = along[0, t]
        least, most = fmin(least, along[0, t]), fmax(most, along[0, t])
    # without the tolerance, rounding of the coordinates could assign nodes of the grid
    # line at the median to different halves
    value = find(&along[1, 0], n, n // 2) - 1e-9 * (most - least)
    for t in range(n):
        side[part[t]] = cut + (along[0, t] >= value)
    for t in range(n):
        a = part[t]
        copy[t], kind[t] = a, 0
        if side[a] == cut + 1:
            kind[t] = 1
            for s in range(ptr[a], ptr[a + 1]):
                if side[idx[s]] == cut:
                    kind[t] = 2
                    break
        count[kind[t]] += 1
    middle[0], separator[0] = count[0], count[0] + count[1]
    count[0], count[1], count[2] = 0, middle[0], separator[0]
    for t in range(n):
        part[count[kind[t]]] = copy[t]
        count[kind[t]] += 1


cdef void coordinates(
    const double[:, :] points, const int[::1] part, double[::1] along
) noexcept:
    """Write the coordinates of the nodes `part` along their longest principal axis."""
    cdef Py_ssize_t t, k, l, n = part.shape[0], dim = points.shape[1]
    cdef double[3] mean = [0.0, 0.0, 0.0]
    cdef double[3] axis
    cdef double[3][3] C = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    for t in range(n):
        for k in range(dim):
            mean[k] += points[part[t], k]
    for k in range(dim):
        mean[k] /= n
    for t in range(n):
        for k in range(dim):
            axis[k] = points[part[t], k] - mean[k]
        for k in range(dim):
            for l in range(k, dim):
                C[k][l] += axis[k] * axis[l]
    principal_axis(C, dim, axis)
    for t in range(n):
        along[t] = (points[part[t], 0] - mean[0]) * axis[0]
        for k in range(1, dim):
            along[t] += (points[part[t], k] - mean[k]) * axis[k]


cdef void principal_axis(double[3][3] C, Py_ssize_t dim, double[3] axis) noexcept:
    """Write the eigenvector for the largest eigenvalue of C (upper triangle) to `axis`.

    In 3D, the eigenvector is computed by the cyclic Jacobi method. Off-diagonal
    entries due to rounding are not eliminated, so that a cube is bisected across its
    edges.
    """
    cdef Py_ssize_t k, l, j, sweep, longest = 0
    cdef double angle, c, s, one, other, size = C[0][0] + C[1][1] + C[2][2]
    cdef double[3][3] V = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    if dim == 2:
        angle = atan2(2 * C[0][1], C[0][0] - C[1][1]) / 2
        axis[0], axis[1] = cos(angle), sin(angle)
        return
    for k in range(1, 3):
        for l in range(k):
            C[k][l] = C[l][k]
    for sweep in range(SWEEPS):
        for k in range(2):
            for l in range(k + 1, 3):
                if fabs(C[k][l]) <= ROUNDING * size:
                    continue
                angle = atan2(2 * C[k][l], C[k][k] - C[l][l]) / 2
                c, s = cos(angle), sin(angle)
                for j in range(3):  # C and V times the rotation from the right …
                    one, other = C[j][k], C[j][l]
                    C[j][k], C[j][l] = c * one + s * other, c * other - s * one
                    one, other = V[j][k], V[j][l]
                    V[j][k], V[j][l] = c * one + s * other, c * other - s * one
                for j in range(3):  # … and its transpose times C from the left
                    one, other = C[k][j], C[l][j]
                    C[k][j], C[l][j] = c * one + s * other, c * other - s * one
    for k in range(1, 3):  # if axes are equally long up to rounding, select the first
        if C[k][k] > C[longest][longest] + ROUNDING * size:
            longest = k
    for k in range(3):
        axis[k] = V[k][longest]


cdef double find(double *v, Py_ssize_t n, Py_ssize_t k) noexcept:
    """Return the k-th smallest entry of v (n,), k = 0, 1, …; v is reordered.

    Source: Hoare, Algorithm 65: Find, Comm. ACM 4, 1961.
    """
    cdef Py_ssize_t i, j, low = 0, high = n - 1
    cdef double pivot
    while low < high:
        pivot, i, j = v[k], low, high
        while i <= j:
            while v[i] < pivot:
                i += 1
            while v[j] > pivot:
                j -= 1
            if i <= j:
                v[i], v[j] = v[j], v[i]
                i += 1
                j -= 1
        if j < k:
            low = i
        if k < i:
            high = j
    return v[k]


def borders(
    const int[::1] ptr,
    const int[::1] idx,
    const int[::1] order,
    const int[::1] start,
    const int[::1] children,
):
    """Compute the borders of all fronts.

    The border of a front consists of the later neighbours of its nodes, and of the
    borders of its children without the nodes of the front.

    Returns first (F + 1,) and border, see `Fronts`.
    """
    cdef Py_ssize_t s, t, i, p, child, end = 0, depth = 0
    cdef Py_ssize_t nodes = order.shape[0], fronts = children.shape[0]
    firsts = np.zeros(fronts + 1, dtype=np.int32)
    cdef int[::1] first = firsts, stack = np.empty(fronts, dtype=np.int32)
    cdef int[::1] position = np.empty(nodes, dtype=np.int32)
    cdef int[::1] seen = np.full(nodes, -1, dtype=np.int32)
    entries = np.empty(8 * nodes, dtype=np.int32)  # enlarged as needed
    cdef int[::1] unsorted = entries
    for p in range(nodes):
        position[order[p]] = p
    for s in range(fronts):
        if end + nodes > unsorted.shape[0]:
            entries = unsorted = np.resize(entries, 2 * entries.size)
        for i in range(children[s]):
            depth -= 1
            child = stack[depth]
            for t in range(first[child], first[child + 1]):
                p = unsorted[t]
                if p >= start[s + 1] and seen[p] != s:
                    seen[p], unsorted[end] = s, p
                    end += 1
        for i in range(start[s], start[s + 1]):
            for t in range(ptr[order[i]], ptr[order[i] + 1]):
                p = position[idx[t]]
                if p >= start[s + 1] and seen[p] != s:
                    seen[p], unsorted[end] = s, p
                    end += 1
        first[s + 1] = end
        stack[depth] = s
        depth += 1

    # sort each border by two counting sorts at linear cost: by position, then by front
    cdef int[::1] at = np.append(0, np.bincount(entries[:end], minlength=nodes)).cumsum(
        dtype=np.int32
    )
    cdef int[::1] of_front = np.empty(end, dtype=np.int32), filled = firsts.copy()
    border = np.empty(end, dtype=np.int32)
    cdef int[::1] ascending = border
    for s in range(fronts):
        for t in range(first[s], first[s + 1]):
            of_front[at[unsorted[t]]] = s
            at[unsorted[t]] += 1
    t = 0
    for p in range(nodes):
        while t < at[p]:
            ascending[filled[of_front[t]]] = p
            filled[of_front[t]] += 1
            t += 1
    return firsts, border

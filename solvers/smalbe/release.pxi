cdef bint step_by_factor(MPRGP at) except -1:
    """Release components at bounds and step with the factor of the enlarged free set.

    Let F be the free components and the components at a bound from which −g points into
    the set. With the projection Π onto the set,

        s = Π(x − M⁻¹g_F) − x,    x ← x + αs

    where M ≈ P_FF is the incomplete factorisation and α minimises the cost along s
    within the set: a projected Newton step if M is exact. Neighbours in the graph of P,
    up to a distance of `layers` edges, are also released, because the boundary of a
    contact zone would otherwise move by only about one component in a step. If at least
    half of them leave their bounds, the number of layers is doubled, otherwise halved,
    as it is after an expansion. With τ ≥ ‖H‖ and p = Π(x − g/τ) − x, the step to x + p
    would decrease the cost by at least −gᵀp/2, because gᵀp ≤ −τ‖p‖². A step that
    achieves less is replaced by a gradient projection step.
    """
    cdef Py_ssize_t i, count = 0, released, freed = 0, n = at.n
    cdef IncompleteFactor factor = at.factor
    cdef double *wide = factor.wanted
    cdef double *beta = at.t
    cdef double least, length
    at.set.minimise(at.x, at.g, at.B.tau, at.s)
    least = -0.5 * dot(at.g, at.s, n)
    memcpy(wide, at.free, n * sizeof(double))
    at.set.project_gradient(at.x, at.g, beta)
    add(-1.0, at.phi, beta, n)
    for i in range(n):
        if beta[i] != 0:
            wide[i], factor.queue[count] = 1.0, <int> i
            count += 1
    released = count
    count = factor.widen(wide, count, at.layers)
    factor.enter(wide)
    masked(wide, at.g, at.phi, n)
    factor.inverse(at.phi, at.z)
    at.set.minimise(at.x, at.z, 1.0, at.s)
    if dot(at.g, at.s, n) < 0:
        length = at.searched(at.s, at.Hs)
        if isinf(length):
            return 0
        if change_along(&at.line, length) <= -least:
            at.to(length, at.s, at.Hs)
            for i in range(released, count):
                freed += at.free[factor.queue[i]] != 0
            if 2 * freed >= count - released:
                at.layers = min(2 * at.layers, n) if at.layers else 1
            else:
                at.layers //= 2
            return 1
    at.layers = 0
    return at.step_by_model()

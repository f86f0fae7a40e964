# cython: language_level=3, cdivision=True
"""Componentwise scales and errors of KKT residuals for arrays.

The formulas are in `scales.h`. This module provides them as NumPy ufuncs, which also
accept vectors distributed over ranks. The module is compiled when the package is
installed; `scales.pyi` declares its types.
"""

cimport cython


@cython.ufunc
cdef double energy_scales(double quadratic, double linear, double work):
    return energy_scale(quadratic, linear, work)


@cython.ufunc
cdef double variable_sizes(double energy, double linear, double curvature, double x):
    return variable_size(energy, linear, curvature, x)


@cython.ufunc
cdef double minimum_shifts(double Px, double curvature, double x):
    return minimum_shift(Px, curvature, x)


@cython.ufunc
cdef double own_sizes(double Px, double curvature, double x):
    return own_size(Px, curvature, x)


@cython.ufunc
cdef double row_scales(double rhs, double sizes, double own):
    return row_scale(rhs, sizes, own)


@cython.ufunc
cdef double excesses(double error, double rounding, double scale):
    return ratio(beyond(error, rounding), scale)


@cython.ufunc
cdef double balance_errors(double error, double rounding, double own, double step,
                           double x, double room, double energy):
    return balance_error(beyond(error, rounding), own, step, x, room, energy)

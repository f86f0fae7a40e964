cdef extern from "scales.h" nogil:
    cpdef enum:
        MAX_CANCELLATION
        TERMS_FACTOR
        MAX_LENGTHS
    double energy_scale(double quadratic, double linear, double work)
    double variable_size(double energy, double linear, double curvature, double x)
    double minimum_shift(double Px, double curvature, double x)
    double own_size(double Px, double curvature, double x)
    double row_scale(double rhs, double sizes, double own)
    double ratio(double error, double scale)
    double beyond(double error, double rounding)
    double balance_error(double error, double own, double step, double x, double room,
                         double energy)

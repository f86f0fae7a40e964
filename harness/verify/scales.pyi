import numpy as np

MAX_CANCELLATION: int
MAX_LENGTHS: int
TERMS_FACTOR: int

energy_scales: np.ufunc
variable_sizes: np.ufunc
minimum_shifts: np.ufunc
own_sizes: np.ufunc
row_scales: np.ufunc
excesses: np.ufunc
balance_errors: np.ufunc

"""bsmap: from the log of two perpendicular 2D laser range finders to a 3D map of B-spline surfaces with covariance."""

import os

# One thread for BLAS, before anything loads numpy: with more, the last bits of results change from run to run and
# processes that run side by side (make -j) get in each other's way.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

__version__ = "0.1.0"

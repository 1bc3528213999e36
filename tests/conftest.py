"""What holds for all tests: one thread of linear algebra, set before numpy is imported anywhere."""

import os

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

"""Studies of the diagnosticians on simulated windows: one module per study, all run by one command."""

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # before numpy is imported; parallel workers are processes
os.environ.setdefault("TQDM_DISABLE", "1")  # pyOMA2 draws progress bars otherwise

"""What the diagnosticians find, measured on simulated windows: a module for each study, run by one command."""

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # before numpy is imported: the workers are processes
os.environ.setdefault("TQDM_DISABLE", "1")  # pyOMA2 draws progress bars otherwise

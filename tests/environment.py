"""The environment of every test. Import it before torch is loaded."""

import os

# Threads of several processes that spin while they wait slow a shared machine tenfold.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# The same results on every processor: MKL rounds otherwise with AVX-512 than without. Costs nothing at these sizes.
os.environ.setdefault("MKL_CBWR", "COMPATIBLE")

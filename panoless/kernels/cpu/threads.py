"""How the Numba kernels are compiled and on how many threads they run."""

import numba
import torch

# Everything of LLVM's fast math except `nnan` and `ninf`: inputs that are not finite must still compare as such.
FINITE_AWARE_FAST_MATH = {"reassoc", "nsz", "arcp", "contract", "afn"}


def match_torch_threads() -> int:
    """Run Numba on as many threads as torch, as far as Numba has them; return that number."""
    threads = min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS)
    numba.set_num_threads(threads)
    return threads

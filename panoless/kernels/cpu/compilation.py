"""How kernels are compiled whose loops are plain scalar code for LLVM to vectorize."""

VECTORIZED_LOOPS = {
    "nogil": True,
    "cache": True,
    "error_model": "numpy",
    # Everything of LLVM's fast math except `nnan` and `ninf`: inputs that are not finite must still compare as such.
    "fastmath": {"reassoc", "nsz", "arcp", "contract", "afn"},
}

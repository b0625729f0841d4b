"""How the kernels are compiled."""

from functools import partial

from kpc.jit import compiled

# Not "reassoc": the order of sums would differ between code compiled in this process and the same code from numba's
# cache, so that the first training run on a machine would end elsewhere than the second.
FASTMATH = {"nsz", "arcp", "contract", "afn"}

# Innermost loops run over the channels of one plane. Their number is not a compile-time constant: LLVM would unroll a
# loop of eight before it could vectorise it. They also touch few arrays, as LLVM proves only a handful distinct.
_kernel = partial(compiled, fastmath=FASTMATH, error_model="numpy")

# For functions that create or return arrays.
plain = _kernel()

# For functions that neither create nor return an array. Without numba's runtime (`_nrt=False`, which has no public
# name) references to arrays are not counted, which is atomic and takes a sixth of a step.
bare = _kernel(_nrt=False)

# The same for functions that run many times per sample: an array is about eight arguments, and passing them costs as
# much as the work.
inlined = _kernel(_nrt=False, forceinline=True)

# For functions that Python calls and whose `prange` loops run on all of numba's threads.
parallel = _kernel(parallel=True)

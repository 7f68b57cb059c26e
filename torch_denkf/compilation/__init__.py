"""Compilation: a strategy that runs steps compiled, inductor's passes, tracing of packages, comparison with eager.

Only this package uses torch's private names.

A step is thirty kernels of a microsecond or two; so the overhead of calls and of saved tensors must be small. The
passes only improve speed, not correctness. They are used only with the versions of torch that they were tested with.
"""

from torch_denkf.compilation.captured import CapturedSteps as CapturedSteps
from torch_denkf.compilation.captured import strategy as strategy
from torch_denkf.compilation.compared import check_same_numbers as check_same_numbers
from torch_denkf.compilation.compiled import CompiledSteps as CompiledSteps
from torch_denkf.compilation.in_time import rts_in_time as rts_in_time
from torch_denkf.compilation.libraries import clear_damaged_libraries as clear_damaged_libraries
from torch_denkf.compilation.libraries import clear_full_cache as clear_full_cache
from torch_denkf.compilation.options import need_compiler as need_compiler
from torch_denkf.compilation.options import options_for_processors as options_for_processors
from torch_denkf.compilation.options import worth_checking as worth_checking
from torch_denkf.compilation.shared_gradients import sharing as sharing
from torch_denkf.compilation.tracing import trace_below_autograd as trace_below_autograd

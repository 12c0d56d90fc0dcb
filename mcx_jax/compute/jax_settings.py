"""JAX's settings that may be exported in the user's shell, each with what a command does about it.

Every option of `jax.config` is an environment variable by the name in capitals. They are set once
for other projects and then forgotten, and half of them change numbers or crash here. So each is in
one of three tables: taken out of the command's environment, refused by name, or left to the user.
A test compares the tables with the options that the installed JAX has.

Call `clean` before JAX is imported, which reads the variables. A program of the user's own that
imports mcx_jax is not touched.
"""

import os
import re
import subprocess
import sys

from mcx_jax.errors import UserError

OURS = {
    "the numbers are float32, promoted as MJX, distrax and optax rely on": (
        *("JAX_ENABLE_X64", "JAX_EXPLICIT_X64_DTYPES", "JAX_DEFAULT_MATMUL_PRECISION"),
        *("JAX_NUMPY_RANK_PROMOTION", "JAX_NUMPY_DTYPE_PROMOTION", "JAX_ALLOW_F16_REDUCTIONS"),
        *("JAX_SOFTMAX_CUSTOM_JVP", "JAX_HIGH_DYNAMIC_RANGE_GUMBEL"),
    ),
    "a seed means the same numbers everywhere": (
        *("JAX_DEFAULT_PRNG_IMPL", "JAX_THREEFRY_PARTITIONABLE", "JAX_RANDOM_SEED_OFFSET"),
        *("JAX_ENABLE_CUSTOM_PRNG", "JAX_LEGACY_PRNG_KEY", "JAX_THREEFRY_GPU_KERNEL_LOWERING"),
    ),
    "JAX's ways to build a program, tested with its defaults only": (
        *("JAX_USE_DIRECT_LINEARIZE", "JAX_USE_SHARDY_PARTITIONER", "JAX_USE_MAGMA"),
        *("JAX_REMAT3", "JAX_SCAN3", "JAX_CUSTOM_VJP3", "JAX_REFS_TO_PINS", "JAX_AUTO_PCAST"),
        *("JAX_USE_SIMPLIFIED_JAXPR_CONSTANTS", "JAX_USE_EMIT_PIPELINE_PRIMITIVE"),
        *("JAX_COMPILER_ENABLE_REMAT_PASS", "EAGER_CONSTANT_FOLDING", "CHECK_VMA"),
        *("JAX_REMOVE_SIZE_ONE_MESH_AXIS_FROM_TYPE", "JAX_DISALLOW_MESH_CONTEXT_MANAGER"),
        *("JAX_DISABLE_BWD_CHECKS", "JAX_DISABLE_VMAP_SHMAP_ERROR", "JAX_CHECK_STATIC_INDICES"),
        *(
            "JAX_MUTABLE_ARRAY_CHECKS",
            "JAX_BCOO_CUSPARSE_LOWERING",
            "JAX_EMBEDDED_CONSTANTS_MAX_BYTES",
        ),
        *("JAX_RAGGED_DOT_USE_RAGGED_DOT_INSTRUCTION", "JAX_MOSAIC_ALLOW_HLO"),
        *("JAX_RAGGED_DOT_USE_GPU_PALLAS_TRITON_LOWERING", "JAX_PALLAS_USE_MOSAIC_GPU"),
        *("JAX_PALLAS_POISON_BUFFERS", "JAX_PALLAS_ENABLE_DEBUG_CHECKS"),
        *("JAX2TF_ASSOCIATIVE_SCAN_REDUCTIONS", "JAX2TF_DEFAULT_NATIVE_SERIALIZATION"),
        "JAX_EXPERIMENTAL_UNSAFE_XLA_RUNTIME_ERRORS",
    ),
    "profiles would change the program between two runs": (
        *("JAX_ENABLE_PGLE", "JAX_PGLE_PROFILING_RUNS", "JAX_PGLE_AGGREGATION_PERCENTILE"),
        *("JAX_COMPILATION_CACHE_EXPECT_PGLE", "JAX_XLA_PROFILE_VERSION"),
    ),
    "what .stablehlo files hold": (
        *("JAX_EXPORT_CALLING_CONVENTION_VERSION", "JAX_SERIALIZATION_VERSION"),
        "JAX_EXPORT_IGNORE_FORWARD_COMPATIBILITY",
    ),
    "--device, --distributed and MCX_JAX_CACHE say it": (
        *("JAX_DEFAULT_DEVICE", "JAX_XLA_BACKEND", "JAX_BACKEND_TARGET"),
        *("JAX_MOCK_GPU_TOPOLOGY", "MOCK_NUM_GPU_PROCESSES", "JAX_SORT_DEVICES_BY_PROCESS_INDEX"),
        *("JAX_CPU_COLLECTIVES_IMPLEMENTATION", "JAX_ENABLE_RECOVERABILITY"),
        *("JAX_ENABLE_PREEMPTION_SERVICE", "JAX_SHARE_BINARY_BETWEEN_HOSTS"),
        *("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"),
        # A cache from which nothing is ever taken, or that ends the process when it is damaged.
        *("JAX_COMPILATION_CACHE_CHECK_CONTENTS", "JAX_RAISE_PERSISTENT_CACHE_ERRORS"),
    ),
}
"""{reason: variables that a command takes out of its environment: JAX's default, or our own value,
holds}."""

REFUSED = {
    "NaN is an answer here, that a lost episode is left out for": (
        *("JAX_DEBUG_NANS", "JAX_DEBUG_INFS"),
        *("JAX_ERROR_CHECKING_BEHAVIOR_NAN", "JAX_ERROR_CHECKING_BEHAVIOR_DIVIDE"),
        "JAX_ERROR_CHECKING_BEHAVIOR_OOB",
    ),
    "nothing would be computed, or a thousand times more slowly": (
        *("JAX_DISABLE_JIT", "JAX_NO_EXECUTION", "JAX_NO_TRACING"),
    ),
    "such a check may stop a run halfway": (
        *("JAX_CHECK_TRACER_LEAKS", "JAX_DEBUG_KEY_REUSE", "JAX_ENABLE_CHECKS"),
        *("JAX_TRANSFER_GUARD", "JAX_TRANSFER_GUARD_HOST_TO_DEVICE", "JAX_THREAD_GUARD"),
        *("JAX_TRANSFER_GUARD_DEVICE_TO_HOST", "JAX_TRANSFER_GUARD_DEVICE_TO_DEVICE"),
        *("JAX_ARRAY_GARBAGE_COLLECTION_GUARD", "JAX_DEBUG_LEAKED_CLIENTS_ON_CLEAR_BACKENDS"),
    ),
}
"""{reason: variables that a user sets to look into a program, and that stop this one}."""
OFF = ("", "0", "false", "f", "no", "n", "off", "allow", "ignore", "none")
"""Values of a refused variable that ask for nothing, in small letters."""

LEFT = {
    "where it runs": (
        *("JAX_PLATFORMS", "JAX_PLATFORM_NAME", "JAX_NUM_CPU_DEVICES", "JAX_CUDA_VISIBLE_DEVICES"),
        *("JAX_ROCM_VISIBLE_DEVICES", "JAX_ONEAPI_VISIBLE_DEVICES"),
        *("JAX_PJRT_CLIENT_CREATE_OPTIONS", "JAX_CPU_ENABLE_ASYNC_DISPATCH"),
        *("JAX_CHECK_PROXY_ENVS", "JAX_CROSS_HOST_TRANSFER_SOCKET_ADDRESS"),
        *("JAX_CROSS_HOST_TRANSPORT_ADDRESSES", "JAX_CROSS_HOST_TRANSFER_TIMEOUT_SECONDS"),
        *("JAX_CROSS_HOST_TRANSFER_TRANSFER_SIZE", "JAX_FORCE_DCN_CROSS_HOST_TRANSFERS"),
        *("JAX_CPU_GET_GLOBAL_TOPOLOGY_TIMEOUT_MINUTES", "JAX_DISTRIBUTED_DEBUG"),
        *("JAX_CPU_GET_LOCAL_TOPOLOGY_TIMEOUT_MINUTES",),
        "JAX_SHARE_BINARY_BETWEEN_HOSTS_TIMEOUT_MS",
    ),
    "how well it is compiled: rounding, as XLA_FLAGS": (
        *("JAX_OPTIMIZATION_LEVEL", "JAX_EXEC_TIME_OPTIMIZATION_EFFORT"),
        *("JAX_MEMORY_FITTING_LEVEL", "JAX_MEMORY_FITTING_EFFORT"),
        "JAX_DISABLE_MOST_OPTIMIZATIONS",
    ),
    "the cache: speed alone": (
        *("JAX_ENABLE_COMPILATION_CACHE", "JAX_COMPILATION_CACHE_MAX_SIZE"),
        *("JAX_COMPILATION_CACHE_INCLUDE_METADATA_IN_KEY", "JAX_EXPLAIN_CACHE_MISSES"),
        *("JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES", "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"),
        "JAX_REMOVE_CUSTOM_PARTITIONING_PTR_FROM_CACHE_KEY",
    ),
    "what is logged, dumped and shown": (
        *("JAX_LOG_COMPILES", "JAX_LOG_CHECKPOINT_RESIDUALS", "JAX_LOGGING_LEVEL"),
        *("JAX_DEBUG_LOG_MODULES", "JAX_DUMP_IR_TO", "JAX_DUMP_IR_MODES", "JAX_PPRINT_USE_COLOR"),
        *("JAX_INCLUDE_DEBUG_INFO_IN_DUMPS", "JAX_INCLUDE_FULL_TRACEBACKS_IN_LOCATIONS"),
        *("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "JAX_TRACEBACK_FILTERING", "JAX_SOURCE_URL_SCHEMA"),
        *("JAX_TRACER_ERROR_NUM_TRACEBACK_FRAMES", "JAX_SEND_TRACEBACK_TO_RUNTIME"),
        *("JAX_HLO_SOURCE_FILE_CANONICALIZATION_REGEX", "JAX_PALLAS_VERBOSE_ERRORS"),
        *("JAX_CAPTURED_CONSTANTS_WARN_BYTES", "JAX_CAPTURED_CONSTANTS_REPORT_FRAMES"),
        "JAX_COMPILER_DETAILED_LOGGING_MIN_OPS",
    ),
}
"""{why they may stay: variables}."""


def names(table: dict[str, tuple[str, ...]]) -> list[str]:
    """The variables of a table."""
    return [name for group in table.values() for name in group]


def clean(known_flags: str) -> list[str]:
    """Take the variables of OURS out of the environment.

    Args:
        known_flags: pattern of XLA flags that this jaxlib is known to take.

    Returns:
        A line that names them, if there were any.

    Raises:
        UserError: a variable of REFUSED is set; XLA would abort the process at its XLA_FLAGS.
    """
    for why, group in REFUSED.items():
        for name in group:
            if (value := os.environ.get(name, "")).lower() not in OFF:
                raise UserError(f"{name}={value} cannot be used here: {why}; unset {name}")
    _check_xla_flags(os.environ.get("XLA_FLAGS", ""), known_flags)
    taken = [name for name in names(OURS) if os.environ.pop(name, None)]
    listed = ", ".join(taken)
    return [f"without effect here, as the command sets it for itself: {listed}"] if taken else []


def _check_xla_flags(flags: str, known: str) -> None:
    """A flag that this jaxlib does not take, of another release say, aborts the process with a
    stack: another process tries first, where there is a flag that is not `known`."""
    if all(re.fullmatch(known, flag) for flag in flags.split()):
        return
    read = "from jaxlib import _jax; _jax.CompileOptions()"
    done = subprocess.run([sys.executable, "-c", read], capture_output=True, text=True, check=False)
    if done.returncode:
        lines = [line.split("] ", 1)[-1] for line in done.stderr.splitlines()]
        said = next((line for line in lines if "flag" in line), "it ends with a stack")
        raise UserError(
            f"XLA_FLAGS={flags}: jaxlib does not take this ({said}); change or unset it"
        )

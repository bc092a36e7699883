"""What every script here shares: a timer and the line of JSON."""

import json
import platform
import resource
import statistics
import sys
import time
from importlib.metadata import version


def timed(step, repeats, warmup):
    """Call `step` `warmup + repeats` times. Return the median seconds after the warm-up, and all it returned."""
    seconds, results = [], []
    for _ in range(warmup + repeats):
        start = time.perf_counter()
        results.append(step())
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[warmup:]), results


def report(framework, what, threads, packages=("torch",), **figures):
    """Print one line of JSON."""
    unit = 1 if sys.platform == "darwin" else 1024
    line = {
        "framework": framework,
        "what": what,
        **figures,
        "peak_rss_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit,
        "threads": threads,
        "versions": {"python": platform.python_version()} | {name: version(name) for name in packages},
    }
    print(json.dumps(line), flush=True)

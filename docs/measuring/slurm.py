"""Workers on SLURM for `attnwarp-eval run --scheduler`. Copy this file and change its options.

pip install dask-jobqueue
python slurm.py &                                        # on a login node; it ends with Ctrl-C
attnwarp-eval run quick --scheduler scheduler.json       # in the same folder
"""

import json
import pathlib
import signal
import sys

from dask_jobqueue import SLURMCluster

cluster = SLURMCluster(
    queue="short",  # the partition
    walltime="04:00:00",  # far longer than a cell: a worker that ends costs its cell an attempt
    cores=4,  # of a job; one worker with as many threads of the renderer
    processes=1,
    memory="16GB",
    python=sys.executable,  # of an environment that the nodes see, with this version of attnwarp
    # dask pauses a worker that nears its limit, for good: leave the limit to SLURM.
    worker_extra_args=["--memory-limit", "0"],
    local_directory="$TMPDIR",
    job_script_prologue=["export ATTNWARP_CACHE=$TMPDIR/attnwarp"],
)
# Jobs start while cells wait, and end when none is left.
cluster.adapt(minimum=0, maximum=50)
pathlib.Path("scheduler.json").write_text(json.dumps({"address": cluster.scheduler_address}))
try:
    signal.pause()
finally:
    cluster.close()

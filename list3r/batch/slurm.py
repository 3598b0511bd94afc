"""A batch as an array job of SLURM: one element for each memory."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from list3r.batch.engines.base import TaskResources


def slurm_script(words: Sequence[str], count: int, resources: TaskResources, side_by_side: int | None) -> str:
    """Return the script of an array of `count` elements, each of which runs the command of `words` with `--only`."""
    command = shlex.join(["list3r", *words])
    limit = "" if side_by_side is None else f"%{side_by_side}"
    lines = [
        "#!/bin/bash",
        "#SBATCH --job-name=list3r-batch",
        f"#SBATCH --array=0-{count - 1}{limit}",
        f"#SBATCH --cpus-per-task={resources.cpus}",
    ]
    if resources.memory_gb is not None:
        lines.append(f"#SBATCH --mem={round(resources.memory_gb * 1024)}M")
    if resources.gpus:
        lines.append(f"#SBATCH --gpus-per-task={resources.gpus:g}")
    lines += [
        "#SBATCH --requeue",
        "# An element that is run again continues where it stopped, or finds that it is done. After the array,",
        "# the same command without --only writes the manifest and does what is left:",
        f"#   {command}",
        f'exec {command} --only "$SLURM_ARRAY_TASK_ID"',
    ]
    return "\n".join(lines) + "\n"

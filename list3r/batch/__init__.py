"""Many videos, many memories: a task for each video, engines that place tasks, a manifest of their states."""

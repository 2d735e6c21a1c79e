"""The build as a job: its plan, results of earlier builds, and the engines that do the work."""

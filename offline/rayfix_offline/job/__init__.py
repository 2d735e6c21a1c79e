"""The build as a job: what is to be done, what an earlier build left, and who does it."""

"""What the runs of Gaussians and those of fields have in common where they resume."""

CHECKPOINT = "checkpoint.npz"
"""File name of the checkpoint in the folder of a run."""

FREE = ("device", "checkpoint_every", "eval_every", "memory_limit")
"""Settings that may differ when a run resumes: they do not change the result, unless a limit of memory is reached,
and then the user lowers it."""

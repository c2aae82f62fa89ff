"""Training with several processes, which torchrun starts: what they agree on, and when.

Without torchrun there is one process, :class:`~sb3_policyflow.distributed.ranks.Alone`, and
``torch.distributed`` is neither initialized nor asked for anything.
"""

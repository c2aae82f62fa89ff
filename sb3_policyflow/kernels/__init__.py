"""The same numbers, sooner: compiled kernels for the networks of flow policies on CPUs.

Every part says by itself what it serves and leaves the rest to plain torch.
"""

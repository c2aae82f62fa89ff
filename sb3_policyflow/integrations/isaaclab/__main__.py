"""``python -m sb3_policyflow.integrations.isaaclab``: train PolicyFlow on a task of IsaacLab."""

import sys

from sb3_policyflow.integrations.isaaclab.train import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""PolicyFlow on IsaacLab's environments: a training script and the paper's hyperparameters.

.. code-block:: bash

    python -m sb3_policyflow.integrations.isaaclab \
        --task Isaac-Velocity-Flat-Anymal-D-v0 --num_envs 4096

Nothing of IsaacLab is imported before the script runs.
"""

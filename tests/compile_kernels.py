"""Compile the kernels that most tests use: ``python -m tests.compile_kernels``, before the workers of pytest start.

The first start takes a quarter of a minute. Otherwise every worker that needs a kernel waits while another compiles it.
"""

import numpy as np

from fe_likelihoods import DisplacementHistory, RCColumn
from fe_likelihoods.problems import bridge_column_data, isolated_bridge


def main() -> None:
    """Simulate a column under both kinds of loading, and an isolated bridge."""
    models = (
        RCColumn.lhpost(bridge_column_data().record.trim(0.0, 0.1)),
        RCColumn.lhpost(DisplacementHistory("cycle", [0.0, 0.01, 0.0]), parameters=["Ec"]),
        isolated_bridge().likelihood.model,
    )
    for model in models:
        model.simulate(np.ones(len(model.parameter_names)))


if __name__ == "__main__":
    main()

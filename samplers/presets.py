"""Settings of published runs, by name: ``SMCSampler(1000, ndim, f, **presets.RAMANCHA_2022_LITERAL)``.

`RAMANCHA_2022_CONSTANT` and `RAMANCHA_2022_LITERAL` are for `SMCSampler`. Ramancha, Astroza, Conte, Restrepo & Todd
(2022) update a bridge column with 1000 particles, multinomial resampling and 10 Metropolis steps per stage, and choose
beta so that "ESS_j = 0.95 ESS_{j-1}" (their Table 1): of the number of particles, since all weights are equal after
resampling (constant), or of a target that decreases by 5 % per stage, 950, 902, 857, ..., to a floor of 50 (literal).
The scale of their random walk is not given; 2.38 / sqrt(ndim) is used.

`CHING_CHEN_2007` is for `TMCMCSampler`: coefficient of variation 1 of the weights (an effective sample size of half the
walkers), multinomial leaders, one Metropolis step per point, covariance 0.04 times the weighted covariance (Ching &
Chen 2007, doi:10.1061/(ASCE)0733-9399(2007)133:7(816)). It can collapse on sharp posteriors; the default of
`TMCMCSampler` does not.

None of these settings makes sweeps over fast parameters, which are not in the papers.

Examples
--------
>>> published = SMCSampler(100, posterior.ndim, posterior, vectorize=True, **presets.RAMANCHA_2022_LITERAL)
>>> published.settings.min_moves, published.settings.resampling
(10, 'multinomial')
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from .moves.population_moves import RandomWalkMove

_COMMON = {
    "moves": RandomWalkMove(),  # a sampler copies its moves, so runs do not share it
    "recycle": False,
    "ess_ratio": 0.95,
    "resampling": "multinomial",
    "min_moves": 10,
    "max_moves": 10,
    "fast_sweeps": 0,
}
RAMANCHA_2022_CONSTANT: Mapping[str, Any] = MappingProxyType(_COMMON)
RAMANCHA_2022_LITERAL: Mapping[str, Any] = MappingProxyType({**_COMMON, "ess_floor": 50.0})
CHING_CHEN_2007: Mapping[str, Any] = MappingProxyType(
    {
        "moves": RandomWalkMove(scale=0.2),
        "resampling": "multinomial",
        "chains": "leaders",
        "burn_in": 0,
        "fast_sweeps": 0,
    }
)

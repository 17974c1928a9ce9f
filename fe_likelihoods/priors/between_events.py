"""How much structural parameters differ between events of one structure, by the beginning of their names."""

BETWEEN_EVENTS = {"frequency": 0.02, "stiffness": 0.04, "damping": 0.2}
"""Standard deviations of the logarithms between events of one structure.

Frequencies of an undamaged building wander with wind, rain, temperature and small earthquakes (J. F. Clinton,
S. C. Bradford, T. H. Heaton, J. Favela, 2006, The observed wander of the natural frequencies in a structure, Bulletin
of the Seismological Society of America 96, 237-257); 2 % is assumed, and a stiffness changes twice as much. Damping
ratios of a bridge scatter by 0.4 and more, most of which its fits make up for: 0.1 to 0.3 predicts its events best
(docs/theory/prediction.rst).
"""

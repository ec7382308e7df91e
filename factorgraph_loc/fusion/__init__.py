"""The estimators, behind one interface (:mod:`factorgraph_loc.fusion.base`)."""

"""ScopeNet, the embedded depth network: what it is told (planes), the network, and the estimator around it."""

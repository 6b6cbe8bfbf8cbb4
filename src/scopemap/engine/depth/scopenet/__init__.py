"""ScopeNet, the embedded depth network: input planes, network, and estimator."""

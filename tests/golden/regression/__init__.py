"""Results of every estimator on small logs that are held, so that a change of any is seen: scenarios, records, differences."""

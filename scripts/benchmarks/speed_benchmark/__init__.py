"""Speed beside fixed reference workloads (``scripts/bench --quick``) and beside other packages (``scripts/bench peers``)."""

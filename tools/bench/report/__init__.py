"""kpbench report: the trades of KPC, drawn from benchmark records on one page."""

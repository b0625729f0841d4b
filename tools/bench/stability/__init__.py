"""kpbench stability: every stage of a ray's and a number's life against float64, at values from small to large."""

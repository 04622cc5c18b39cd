"""Memory and the worst steps over long runs, the time until the first step, and throughput of many processes."""

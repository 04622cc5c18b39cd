"""The arena: laws of avoidance, and other libraries, on families of scenarios, judged by an independent simulator."""

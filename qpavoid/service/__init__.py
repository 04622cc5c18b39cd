"""The controller as a service, for programs in other processes and languages."""

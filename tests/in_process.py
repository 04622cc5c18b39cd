"""Workers for tests of sweeps: they work in the process of the test, as others take seconds to start."""


class InProcess:
    """What a sweep asks of `qpavoid.run.pool.Workers`, one call after the other."""

    def __init__(self, jobs=None):
        """Take the number of jobs as `Workers` do."""

    def __len__(self):
        return 1

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def as_completed(self, function, calls):
        for call in calls:
            try:
                yield call, function(*call)
            except Exception as error:
                yield call, error

"""Hooks of pytest: a run that lost tests, as xdist may where a worker dies, does not pass."""

reported = set()


def pytest_runtest_logreport(report):
    """Note each test that was reported."""
    reported.add(report.nodeid)


def pytest_sessionfinish(session, exitstatus):
    """Fail where the workers collected tests that nobody reported."""
    workers = session.config.pluginmanager.get_plugin("dsession")
    collected = getattr(getattr(workers, "sched", None), "collection", None) or ()
    lost = sorted({*collected} - reported)
    if lost and exitstatus == 0:
        print(f"\n{len(lost)} tests were lost with their worker, such as {lost[0]}")
        session.exitstatus = 1

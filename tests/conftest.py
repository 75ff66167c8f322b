"""Settings that every test shares: strict dtypes, few simulation threads, reproducible hypothesis runs."""

import hypothesis

hypothesis.settings.register_profile("fleetjax", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("fleetjax")

"""Random problems are the same in every run; `make fuzz` draws others."""

import hypothesis

hypothesis.settings.register_profile("qp", max_examples=20, deadline=None, derandomize=True)
hypothesis.settings.load_profile("qp")

"""The report: the paper's tables beside ours, verdicts, pictures, and validation.json for programs.

Everything is computed from what the stages left in work/<case>/ and from the case itself; no model,
no store and no runtime is loaded. ``pipeline.stages.report`` writes it to artifacts/<case>/.
``overview`` makes one page over all cases of the validation.json of each, and imports none of the rest.
"""

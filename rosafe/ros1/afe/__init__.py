"""The rosAFE node: the processor tree behind a component's requests and ports."""

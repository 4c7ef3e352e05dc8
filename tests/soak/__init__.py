"""The soak: real nodes under load and faults for any time. `scripts/soak` runs it; the test suite runs one round."""

from rosafe.ros1.component import generate

generate.ensure_messages()  # its modules import rosAFE.msg

"""The soak: real nodes under load and faults for as long as one likes. `scripts/soak` runs it, the suite one round."""

from rosafe.component import generate

generate.ensure_messages()  # its modules import rosAFE.msg

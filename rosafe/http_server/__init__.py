"""What the HTTP servers of the project share (genomixd and the live page), on aiohttp.

`access` checks Host and Origin, `connections` limits connections and their memory, `listener` serves an application
with these limits, `refusal` is the exception for what is refused.
"""

"""Parts shared by the HTTP servers of the project (genomixd and the live page), based on aiohttp.

`access` checks Host and Origin, `connections` limits connections and their memory, `listener` serves an application
with these limits, and `refusal` is the exception for refused requests.
"""

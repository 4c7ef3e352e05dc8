"""The live page: what the robot hears, in any browser; `rosafe live`.

`server` speaks HTTP, `client` is one page, `hub` the pictures that somebody looks at, `ports` what is subscribed for
them, `pictures` what can be shown and how it is reduced, `robot` what the components are asked, `health` what they tell
of themselves. `page/` is what the browser gets.
"""

"""The live page of `rosafe live`: the audio and the output of the processors, in a browser.

`server` is the HTTP server, `client` the connection of one page and the views that it shows, `views` the views of all
pages, `plot_data` the reduction of frames to the columns of a plot, `audio` the sound, `components` the requests to the
components, `health` the content of /diagnostics. `page/` is served to the browser.
"""

"""Live page: a server that shows lit frames in a browser, uses the browser's camera, and edits the scene.

``host`` lights frames on a thread, ``edits`` changes scenes, ``protocol`` defines the messages between page and server,
``server`` is the only module that uses HTTP.
"""

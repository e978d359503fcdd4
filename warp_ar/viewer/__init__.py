"""Live page: a server that shows lit frames in a browser, uses the browser's camera, and edits the scene.

``host`` runs frames on a thread, ``edits`` changes scenes, ``protocol`` is what page and server may say to each other,
``server`` is the only module that speaks HTTP.
"""

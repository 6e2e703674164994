"""The page of ``play``. What each file holds, from the drive to the browser:

- ``drivers.py``: an agent or a planner that drives one robot
- ``arenas.py``: the worlds, a map with goals as in training or the office
- ``play_drive.py``: the drive of one robot or two; no web in it
- ``drive_clock.py``: the thread that drives, takes orders and hands out views
- ``view_state.py``: what is shown of a robot, computed as plain arrays
- ``offers.py``: agents and maps that a server offers, by name
- ``scene_choice.py``: what a page shows, as a link says it
- ``page_link.py``: the link, read and checked
- ``cast.py``: who drives a scene, checked against what is offered
- ``map_figure.py``: the map from above
- ``critic_figures.py``: the return's quantile curve, and the value of every action
- ``stage.py``: all figures of a page
- ``palette.py``: the page's colours, light and dark
- ``controls.py``: the widgets
- ``visitor.py``: what a visitor does with them, as orders to the drive
- ``silence.py``: tells a visitor's changes from the page's own
- ``play_film.py``: films of what was shown
- ``play_page.py``: one visitor's page, of all these
- ``page.html``, ``page.css``, ``widget.css``: its layout and style
- ``page.js``, ``page_words.py``: what the browser does by itself, and the words that it writes
- ``page_lost.js``: what the page does when its server is gone
- ``gate.py``, ``refusal.html``: whose browser may connect, and what others read
- ``play_server.py``: the server of all pages
- ``play_session.py``: what the verb makes of its config
- ``notebook_view.py``: the page in a notebook
"""

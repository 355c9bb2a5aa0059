"""The local application: a page for this machine only, for the campaigns of one folder.

Other rooms make its contents: a report's blocks, a plan's forecast. Every action of the page is
also a command, which the page shows.

- `server`: `serve` a folder as a page in the browser; limits of connections in number and time
- `access_control`: access to the server, limits of requests, and the browser's permissions
- `served_folder`: the files of the folder, and no others; versions, so that no edit is lost
- `app_state`: the state that all requests share; `commands`: the command line of each action
- `campaigns`: the folder's campaigns and results, with their state
- `drafts`: campaigns from uploaded exports: columns, questions and descriptions
- `checklist`: optional entries of a description that matter to its result
- `campaign_files`: uploads; campaigns copied, renamed and moved to the trash
- `form`, `editing`: a form made of the models' keys, next to the text of a campaign or laboratory
- `jobs`: long work, each in its own process: calibrations, studies, plans; live views
- `pages`: results, comparisons and histories as the reports' words and pictures; the documentation
- `what_if`: the uncertainty with better inputs, and campaigns prepared for them
- `record_plots`: plots of records and fits; checks of runs; studies and simulations
- `plans`: plans with movable limits
- `laboratory`: the laboratory's data for a certificate, their preview and profile
- `certification`: certificates, reports, and downloads
- `endpoints`: the requests of the page, by name; `answers`: the types of their answers

Throughout, `app` is the shared state, and `name` is a file or a campaign's folder within it.

The page itself is in the folder "assets": modules as a browser reads them, no build step.
"""

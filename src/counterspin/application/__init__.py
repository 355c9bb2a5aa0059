"""The local web application for the campaigns of a folder.

Other packages compute the contents, such as the blocks of a report or the forecast of a plan. Every
action of the page is also a command, which the page shows.

- `server`: `serve` a folder as a page in the browser; limits of connections in number and time
- `access_control`: access to the server, limits of requests, and the browser's permissions
- `served_folder`: access restricted to the folder; file versions, so that no edit is lost
- `app_state`: the state that all requests share; `commands`: the command line of each action
- `campaigns`: the folder's campaigns and results, with their state
- `drafts`: campaigns from uploaded exports: columns, questions and descriptions
- `checklist`: optional entries of a description that affect the result
- `campaign_files`: uploads; campaigns copied, renamed and moved to the trash
- `form`, `editing`: forms made from the models, and the text of a campaign or laboratory data
- `jobs`: calibrations, studies and plans in separate processes; live views
- `pages`: results, comparisons and histories as HTML; the documentation
- `what_if`: the uncertainty with better inputs, and campaigns prepared for them
- `record_plots`: plots of records and fits; checks of runs; studies and simulations
- `plans`: plans with adjustable limits
- `laboratory`: laboratory data for a certificate, preview and profile
- `certification`: certificates, reports, and downloads
- `endpoints`: request handlers by name; `answers`: types of the responses

In all modules, `app` is the shared state, and `name` is a file or campaign folder relative to the
served folder.

The page itself is in the folder "assets", as JavaScript modules without a build step.
"""

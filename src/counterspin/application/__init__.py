"""The local application: a page for this machine only, for the campaigns of one folder.

Other rooms make its contents: a report's blocks, a plan's forecast. Every action of the page is
also a command, which the page shows.

- `server`: `serve` a folder as a page in the browser; limits of connections in number and time
- `guard`: access control, limits of requests, and the browser's permissions
- `folder`: the files of the folder, and no others; versions, so that no edit is lost
- `desk`: the state that all requests share; the command line of each action
- `campaigns`: the folder's campaigns and results, with their state
- `drafts`: campaigns from uploaded exports: columns, questions and descriptions
- `checklist`: optional entries of a description that matter to its result
- `keeping`: files that are uploaded, and campaigns copied, renamed and moved to the trash
- `form`, `editing`: a form made of the models' keys, next to the text of a campaign or laboratory
- `jobs`: long work, each in its own process: calibrations, studies, plans; live views
- `pages`: results, comparisons and histories as the reports' words and pictures; the documentation
- `improving`: a fit's view of records; the uncertainty with better inputs, and campaigns prepared
  for that
- `record_plots`: records through a window of time; judgements of runs; studies and simulations
- `plans`: plans with movable limits
- `laboratory`: the laboratory's data for a certificate, their preview and profile
- `certification`: certificates, reports, and downloads
- `interface`: the requests of the page, by name

Throughout, `desk` is the served state, and `name` is a file or a campaign's folder within it.

The page itself is in the folder "assets": modules as a browser reads them, no build step.
"""

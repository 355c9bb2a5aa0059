"""The local application: a page of this machine alone, over the campaigns of one folder.

What it shows is made by the other rooms: a report's own blocks, a plan's forecast. Each thing that
is done by a click is a command too, and the page says which.

- `server`: `serve`, from a folder to a page in the browser
- `guard`: who may ask, how much, and what a browser may do with the answer
- `connections`: how many, and how long they may take
- `folder`: the files of the folder, and no others; versions, so that no edit is lost
- `desk`: what all requests share
- `campaigns`: the folder's campaigns and results, with their state
- `keeping`: campaigns copied, renamed and put away
- `form`, `editing`, `descriptions`: a form made of the models' keys, the text beside it, and both
  of a campaign or a laboratory
- `manual`: the documentation, and which of its pages explains what
- `processes`: work in a process of its own, told through a pipe
- `jobs`: what takes longer than a moment, one thing after the other: calibrations, studies,
  simulations, forecasts, plans
- `pages`: results, comparisons and histories as the reports' words and pictures
- `improving`: what an uncertainty would be if more were known, and campaigns prepared for that
- `record_plots`, `fits`: records through a window of time; what a fit says of them
- `drafts`: exports that are dragged in, and the campaigns that they make
- `live`, `judging`: processes kept while somebody looks: campaigns that are followed while their
  records grow, plans whose limits are moved; runs that are judged
- `plans`: plans whose limits are moved
- `trying`: studies and simulations of campaigns
- `certification`: certificates, reports, and files that are taken away
- `commands`: what a click does, as the words of a command line
- `interface`: what the page may ask, by name

Throughout, `desk` is what is served, and `name` is a file or a campaign's folder within it.

The page itself stands in the folder "assets": modules as a browser reads them, no build step.
"""

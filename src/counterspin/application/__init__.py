"""The local application: a page of this machine alone, over the campaigns of one folder.

What it shows is made by the other rooms: a report's own blocks, a plan's forecast. Each thing that
is done by a click is a command too, and the page says which.

- `temporary_folders`: temporary folders, also those that a killed server left
- `server`: `serve`, from a folder to a page in the browser; how many connections, and how long they
  may take
- `guard`: who may ask, how much, and what a browser may do with the answer
- `folder`: the files of the folder, and no others; versions, so that no edit is lost
- `desk`: what all requests share; what a click does, as the words of a command line
- `campaigns`: the folder's campaigns and results, with their state
- `keeping`: campaigns made of exports that are dragged in, copied, renamed and put away
- `form`, `editing`: a form made of the models' keys, the text beside it, and both of a campaign or
  a laboratory
- `jobs`: what takes longer than a moment, each in a process of its own: calibrations, studies,
  plans; and what is followed while somebody looks
- `pages`: results, comparisons and histories as the reports' words and pictures; the documentation
- `improving`: what a fit says of records; what an uncertainty would be if more were known, and
  campaigns prepared for that
- `record_plots`: records through a window of time; runs judged; studies and simulations
- `plans`: plans whose limits are moved
- `certification`: certificates, reports, and files that are taken away
- `interface`: what the page may ask, by name

Throughout, `desk` is what is served, and `name` is a file or a campaign's folder within it.

The page itself stands in the folder "assets": modules as a browser reads them, no build step.
"""

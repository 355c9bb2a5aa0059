// @ts-check
// Types of the server's answers. `python docs/answer_types.py` makes this file.

/**
 * The key for further requests.
 * @typedef {{
 *   key: string,
 * }} SessionKey
 */

/**
 * An uploaded file.
 * @typedef {{
 *   name: string,
 *   bytes: number,
 * }} StoredFile
 */

/**
 * The name of a folder or a file.
 * @typedef {{
 *   name: string,
 * }} NameAnswer
 */

/**
 * A campaign that was written.
 * @typedef {{
 *   name: string,
 *   command: string,
 * }} WrittenCampaign
 */

/**
 * A job and its progress.
 * @typedef {{
 *   number: number,
 *   campaign: string,
 *   output: string,
 *   command: string,
 *   kind: "calibration" | "study" | "estimate" | "simulation" | "forecast" | "plan" | "fit" | "sample",
 *   state: "waiting" | "running" | "done" | "failed" | "stopped",
 *   progress: [number, number],
 *   error: string,
 *   seconds: number,
 * }} JobEntry
 */

/**
 * A text with its name.
 * @typedef {{
 *   name: string,
 *   text: string,
 * }} NamedText
 */

/**
 * A result in a list; a damaged result has only a state.
 * @typedef {{
 *   name: string,
 *   state: string,
 *   words: string,
 *   title?: string,
 *   method?: string,
 *   answers?: NamedText[],
 *   serial_numbers?: (string | null)[],
 *   written?: number,
 *   description?: string,
 * }} ResultEntry
 */

/**
 * A campaign in a list.
 * @typedef {{
 *   name: string,
 *   title: string,
 *   results: ResultEntry[],
 *   mistakes: string[],
 *   missing: string[],
 *   runs: number,
 *   instruments: string[],
 *   state: string,
 *   words: string,
 * }} CampaignEntry
 */

/**
 * A run of a campaign; rate and record are None if the description has mistakes.
 * @typedef {{
 *   name: string,
 *   rate: number | null,
 *   record: string | null,
 *   bytes: number | null,
 * }} RunEntry
 */

/**
 * An entry of the checklist, with its key in the description.
 * @typedef {{
 *   words: string,
 *   stated: boolean,
 *   effect: string,
 *   key: string,
 * }} ChecklistEntry
 */

/**
 * The data of the page of one campaign.
 * @typedef {{
 *   name: string,
 *   title: string,
 *   results: ResultEntry[],
 *   mistakes: string[],
 *   missing: string[],
 *   runs: number,
 *   instruments: string[],
 *   state: string,
 *   words: string,
 *   study: string | null,
 *   text: string,
 *   version: string,
 *   run_list: RunEntry[],
 *   checklist: ChecklistEntry[],
 *   command: string,
 *   jobs: JobEntry[],
 * }} CampaignOverview
 */

/**
 * A plan in a list.
 * @typedef {{
 *   name: string,
 *   title: string,
 * }} PlanEntry
 */

/**
 * A folder in the trash, and its former name.
 * @typedef {{
 *   place: string,
 *   name: string,
 * }} TrashEntry
 */

/**
 * A coefficient and its description.
 * @typedef {{
 *   name: string,
 *   words: string,
 * }} TermEntry
 */

/**
 * The contents of the served folder.
 * @typedef {{
 *   folder: string,
 *   campaigns: CampaignEntry[],
 *   results: ResultEntry[],
 *   plans: PlanEntry[],
 *   labs: string[],
 *   trash: TrashEntry[],
 *   terms: TermEntry[],
 * }} FolderOverview
 */

/**
 * The name of a folder in the trash; None if no file was moved.
 * @typedef {{
 *   place: string | null,
 * }} TrashPlace
 */

/**
 * A folder from the trash, and the files of an unfinished import.
 * @typedef {{
 *   name: string,
 *   files: string[],
 * }} RestoredFolder
 */

/**
 * Sentences on the runs that were added.
 * @typedef {{
 *   added: string[],
 * }} AddedRuns
 */

/**
 * A field of a form.
 * @typedef {{
 *   key: string,
 *   label: string,
 *   help: string,
 *   links: [string, string][],
 *   required: boolean,
 *   kind: string,
 *   unit?: string,
 *   units?: string[],
 *   example?: string,
 *   choices?: any[],
 *   suggestions?: string[],
 *   names?: Record<string, string>,
 *   rows?: TermRow[],
 *   fields?: FormField[],
 * }} FormField
 */

/**
 * A term that can be in a list of terms.
 * @typedef {{
 *   key: string,
 *   words: string,
 * }} TermRow
 */

/**
 * A section of a form.
 * @typedef {{
 *   key: string,
 *   words: string,
 *   explained: string,
 *   repeat: string | null,
 *   fields: FormField[],
 *   reading_fields?: FormField[],
 *   name_fields?: FormField[],
 *   table_fields?: Record<string, FormField[]>,
 * }} FormSection
 */

/**
 * A message on a key of a document; an empty key means the whole document.
 * @typedef {{
 *   key: string,
 *   words: string,
 * }} KeyedText
 */

/**
 * A text, its document and its mistakes.
 * @typedef {{
 *   text: string,
 *   document: Record<string, any>,
 *   problems: KeyedText[],
 *   questions: string[],
 *   missing: KeyedText[],
 *   run_kinds: string[],
 * }} EditedDocument
 */

/**
 * A text that was saved.
 * @typedef {{
 *   text: string,
 *   document: Record<string, any>,
 *   problems: KeyedText[],
 *   questions: string[],
 *   missing: KeyedText[],
 *   run_kinds: string[],
 *   file: string,
 *   version: string,
 * }} SavedDocument
 */

/**
 * A file with the form that edits it.
 * @typedef {{
 *   text: string,
 *   document: Record<string, any>,
 *   problems: KeyedText[],
 *   questions: string[],
 *   missing: KeyedText[],
 *   run_kinds: string[],
 *   file: string,
 *   version: string,
 *   form: FormSection[],
 * }} EditedFile
 */

/**
 * An issued certificate of a folder.
 * @typedef {{
 *   file: string,
 *   identifier: string,
 * }} IssuedCertificate
 */

/**
 * The laboratory's data for a certificate.
 * @typedef {{
 *   text: string,
 *   document: Record<string, any>,
 *   problems: KeyedText[],
 *   questions: string[],
 *   missing: KeyedText[],
 *   run_kinds: string[],
 *   file: string,
 *   version: string,
 *   form: FormSection[],
 *   signer: string,
 *   profile: boolean,
 *   certificates: IssuedCertificate[],
 * }} LaboratoryData
 */

/**
 * A question about files, and its possible answers.
 * @typedef {{
 *   key: string,
 *   text: string,
 *   example: string,
 *   choices: string[],
 *   guess: string | null,
 *   units: string[],
 * }} QuestionEntry
 */

/**
 * A preview of a column: minimum and maximum of each segment.
 * @typedef {{
 *   extent: ([number, number] | null)[],
 *   words: string,
 *   size: number,
 *   unit: string,
 * }} Curve
 */

/**
 * A column of a file, and the reason why it may be unused; text columns have no curve.
 * @typedef {{
 *   name: string,
 *   first: string[],
 *   curve: Curve | null,
 *   reason: string,
 * }} ColumnEntry
 */

/**
 * An answer from another campaign.
 * @typedef {{
 *   answer: string,
 *   campaign: string,
 * }} RememberedAnswer
 */

/**
 * Detected contents of files, questions and mistakes.
 * @typedef {{
 *   test: "double-turntable" | "tumble" | "arm" | "poses" | null,
 *   statements: string[],
 *   questions: QuestionEntry[],
 *   problems: string[],
 *   file: string,
 *   runs: number | null,
 *   columns: ColumnEntry[],
 *   directions: number[],
 *   remembered: Record<string, RememberedAnswer>,
 * }} DraftOverview
 */

/**
 * A page of the documentation, and names and titles of all pages.
 * @typedef {{
 *   title: string,
 *   html: string,
 *   pages: [string, string][],
 * }} ManualPage
 */

/**
 * A page as HTML; while a job computes the page, all other entries are empty.
 * @typedef {{
 *   job: JobEntry | null,
 *   title: string,
 *   html: string,
 *   command: string,
 *   empty: boolean,
 *   accelerometers: string[],
 *   state: string,
 *   words: string,
 *   refusal: string,
 * }} PageContent
 */

/**
 * A source of uncertainty, in SI or g-units; `factor` converts it to its unit.
 * @typedef {{
 *   name: string,
 *   words: string,
 *   u: number,
 *   factor: number,
 *   unit: string,
 *   share: number,
 * }} WhatIfSource
 */

/**
 * The uncertainty with smaller uncertainties of its sources.
 * @typedef {{
 *   symbol: string,
 *   u: number,
 *   text: string,
 *   sources: WhatIfSource[],
 * }} WhatIfAnswer
 */

/**
 * A prior that reduces the uncertainty of a coefficient.
 * @typedef {{
 *   symbol: string,
 *   source: string,
 *   words: string,
 *   assumed_u: string,
 *   current_u: string,
 *   remaining_u: string,
 * }} PriorImprovement
 */

/**
 * Further runs that reduce the uncertainty of a coefficient.
 * @typedef {{
 *   attitude: string,
 *   count: number,
 *   minutes: string,
 *   remaining_u: string,
 *   current_u: string,
 * }} RunImprovement
 */

/**
 * The best prior and the best further runs of an accelerometer.
 * @typedef {{
 *   accelerometer: string,
 *   stated: PriorImprovement,
 *   runs: RunImprovement | null,
 * }} Improvement
 */

/**
 * Known ways to reduce the uncertainty.
 * @typedef {{
 *   ways: Improvement[],
 *   searched: boolean,
 *   has_runs: boolean,
 * }} Improvements
 */

/**
 * A copied campaign, and the key of the value to be replaced.
 * @typedef {{
 *   name: string,
 *   key: string | null,
 * }} PreparedCopy
 */

/**
 * A column of a record.
 * @typedef {{
 *   name: string,
 *   unit: string,
 * }} RecordColumn
 */

/**
 * Columns of a record and its used time range.
 * @typedef {{
 *   columns_per_plot: number,
 *   columns: RecordColumn[],
 *   rows: number,
 *   first: number,
 *   last: number,
 *   used: (number | null)[],
 *   file: string,
 * }} RecordOverview
 */

/**
 * Overview of a record or its fit; None before the fit.
 * @typedef {{
 *   overview: RecordOverview | null,
 * }} RecordAnswer
 */

/**
 * The values of a record between two times.
 * @typedef {{
 *   time: number[],
 *   columns: ((number | null)[])[],
 *   is_complete: boolean,
 * }} RecordWindow
 */

/**
 * The check of a record.
 * @typedef {{
 *   html: string,
 *   good: boolean,
 *   command: string,
 * }} RunCheck
 */

/**
 * The uncertainty of a coefficient; None if it is not determined.
 * @typedef {{
 *   name: string,
 *   u: number | null,
 * }} NamedUncertainty
 */

/**
 * The uncertainties after a recorded time.
 * @typedef {{
 *   minutes: number,
 *   u: NamedUncertainty[],
 * }} CurrentUncertainties
 */

/**
 * The state of a campaign during recording.
 * @typedef {{
 *   html: string,
 *   events: string[],
 *   complete: boolean,
 *   reached: CurrentUncertainties | null,
 *   error?: string,
 * }} LiveState
 */

/**
 * The state of a campaign during recording, with the command.
 * @typedef {{
 *   html: string,
 *   events: string[],
 *   complete: boolean,
 *   reached: CurrentUncertainties | null,
 *   error?: string,
 *   command: string,
 * }} LiveAnswer
 */

/**
 * The expected duration of a study, s.
 * @typedef {{
 *   preparation: number,
 *   per_trial: number,
 *   slow_analyses: string,
 * }} Duration
 */

/**
 * The expected duration of a study, or the job that estimates the duration.
 * @typedef {{
 *   job: JobEntry | null,
 *   duration: Duration | null,
 * }} DurationAnswer
 */

/**
 * The pages of a certificate as SVG images.
 * @typedef {{
 *   pages: string[],
 * }} CertificatePages
 */

/**
 * A certificate that was written.
 * @typedef {{
 *   identifier: string,
 *   draft: boolean,
 *   accelerometers: string[],
 *   signed_by: string,
 *   notes: string[],
 *   files: string[],
 *   checksums: string[],
 *   pages: string[],
 *   signer: string,
 *   signer_certificate: string | null,
 *   command: string,
 * }} Receipt
 */

/**
 * The check of a certificate's file.
 * @typedef {{
 *   identifier: string,
 *   checksum: string,
 *   signature: "none" | "unchecked" | "valid",
 *   pages: string | null,
 * }} CheckedFile
 */

/**
 * The file of the laboratory's profile.
 * @typedef {{
 *   file: string,
 * }} ProfileFile
 */

/**
 * An address of a file, valid once.
 * @typedef {{
 *   ticket: string,
 * }} Ticket
 */

/**
 * A limit of a plan and its range, in SI; `factor` converts its unit to SI.
 * @typedef {{
 *   key: string,
 *   words: string,
 *   is_integer: boolean,
 *   unit: string,
 *   factor: number,
 *   value: number,
 *   low: number,
 *   high: number,
 * }} Limit
 */

/**
 * A plan with its limits.
 * @typedef {{
 *   name: string,
 *   title: string,
 *   limits: Limit[],
 *   command: string,
 * }} PlanOverview
 */

/**
 * The optimal plan as HTML; empty while a job computes the plan.
 * @typedef {{
 *   job: JobEntry | null,
 *   html: string,
 * }} PlanPage
 */

/**
 * Method -> name of an endpoint -> type of its answer.
 * @typedef {{
 *   POST: {
 *     "session": SessionKey,
 *     "campaign": WrittenCampaign,
 *     "copy": NameAnswer,
 *     "rename": NameAnswer,
 *     "put-away": TrashPlace,
 *     "discard": TrashPlace,
 *     "restore": RestoredFolder,
 *     "sample": JobEntry,
 *     "records": AddedRuns,
 *     "check": EditedDocument,
 *     "change": EditedDocument,
 *     "what-if": WhatIfAnswer,
 *     "ways": JobEntry,
 *     "way": PreparedCopy,
 *     "fit": JobEntry,
 *     "draft": DraftOverview,
 *     "drafted": WrittenCampaign,
 *     "certificate": Receipt,
 *     "certificate-preview": CertificatePages,
 *     "certificate-check": CheckedFile,
 *     "profile": ProfileFile,
 *     "ticket": Ticket,
 *     "plan": NameAnswer,
 *     "plan-page": PlanPage,
 *     "planned": JobEntry,
 *     "jobs": JobEntry,
 *     "study-duration": DurationAnswer,
 *     "study": JobEntry,
 *     "simulation": JobEntry,
 *   },
 *   GET: {
 *     "folder": FolderOverview,
 *     "campaign": CampaignOverview,
 *     "description": EditedFile,
 *     "lab": LaboratoryData,
 *     "plan-text": EditedFile,
 *     "manual": ManualPage,
 *     "page": PageContent,
 *     "ways": Improvements,
 *     "record-about": RecordAnswer,
 *     "record": RecordWindow,
 *     "check": RunCheck,
 *     "watch": LiveAnswer,
 *     "plan": PlanOverview,
 *     "jobs": JobEntry[],
 *   },
 *   PUT: {
 *     "text": SavedDocument,
 *   },
 *   DELETE: {
 *     "jobs": JobEntry,
 *   },
 * }} Answers
 */

export {};

// The parts of the page that write files: loaded when one of them is opened.
export { AssembleView } from "./assemble_view";
export { ProgramView } from "./program_view";

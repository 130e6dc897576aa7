// Starts the page.
import { createRoot } from "react-dom/client";
import "@xyflow/react/dist/style.css";
import "uplot/dist/uPlot.min.css";
import "./app.css";
import "./assemble.css";
import "./program.css";
import { App } from "./app";
import { connect, watchForSilence } from "./connection";

createRoot(document.getElementById("root")!).render(<App />);
connect();
watchForSilence();
// A link works once; the cookie goes on
if (location.search) history.replaceState(null, "", location.pathname);

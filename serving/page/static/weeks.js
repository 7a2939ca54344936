// Time on control, week by week, read when somebody opens it.
import { get } from "./api.js";
import { element } from "./format.js";

export function watch() {
  const box = document.getElementById("weeks");
  box.addEventListener("toggle", async () => {
    if (!box.open) return;
    const list = document.getElementById("week-list");
    try {
      const { weeks } = await get("/api/weeks");
      list.replaceChildren(...weeks.flatMap(week));
    } catch (error) {
      list.replaceChildren(element("p", { class: "note" }, error.message));
    }
  });
}

function week(w) {
  const rows = w.rows.map(([name, ...cells]) => element("tr", {}, element("th", {}, name), ...cells.map((c) => element("td", {}, c))));
  const table = element(
    "div",
    { class: "scroll", tabindex: 0, role: "region", "aria-label": `Week of ${w.week}` },
    element(
      "table",
      {},
      element("thead", {}, element("tr", {}, ...w.columns.map((c) => element("th", {}, c)))),
      element("tbody", {}, ...rows),
    ),
  );
  return [element("h3", {}, w.headline), ...(rows.length ? [table] : []), element("ul", {}, ...w.notes.map((n) => element("li", {}, n)))];
}

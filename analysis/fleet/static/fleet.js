// The fleet's page: it logs in by the link's token, and shows what the server summed up.

const byId = (id) => document.getElementById(id);

async function answer(path, options = {}) {
  const response = await fetch(path, { credentials: "same-origin", ...options });
  const found = await response.json().catch(() => ({}));
  if (!response.ok) throw new Error(found.detail ?? `${path}: ${response.status}`);
  return found;
}

async function logIn() {
  const token = new URLSearchParams(location.hash.slice(1)).get("token");
  if (!token) return;
  // Nobody who looks over a shoulder, or into the history, needs to see it.
  history.replaceState(null, "", location.pathname);
  await answer("api/v1/session", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ token }) });
}

function chosen() {
  const query = new URLSearchParams(new FormData(byId("choice")));
  for (const [key, value] of [...query]) if (!value) query.delete(key);
  return query;
}

async function show() {
  byId("note").textContent = "Loading.";
  byId("fleet").setAttribute("aria-busy", "true");
  const query = chosen();
  const found = await answer(`api/v1/fleet?${query}`);
  byId("fleet").innerHTML = found.html; // made by our own template, which escapes all that journals say
  byId("files").replaceChildren(...found.files.flatMap((name) => {
    const link = document.createElement("a");
    link.href = `api/v1/files/${name}?${query}`;
    link.download = name;
    link.textContent = name;
    return [link, " "];
  }));
  byId("note").textContent = "";
  byId("fleet").removeAttribute("aria-busy");
}

function say(error) {
  byId("note").textContent = `${error.message}.`;
}

byId("choice").addEventListener("submit", (event) => {
  event.preventDefault();
  show().catch(say);
});
addEventListener("hashchange", () => { if (location.hash.includes("token=")) location.reload(); });
logIn().then(show).catch(say);

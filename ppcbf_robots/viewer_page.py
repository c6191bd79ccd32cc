"""The page around a meshcat scene: one self-contained HTML file, and a server for it that is reachable from here only.

meshcat's own server is not used: it listens on every interface, lives in a child process that survives its parent, and
prints to stdout. A finished run needs none of it: the scene's commands are stored in the page and replayed by meshcat's
viewer script, each array once however many robots share it.
"""

from __future__ import annotations

import base64
import gzip
import html
import json
import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import meshcat

from ppcbf_robots.errors import InputError

_ARRAY_TYPES = {0x12: "Uint8Array", 0x15: "Int32Array", 0x16: "Uint32Array", 0x17: "Float32Array"}  # of meshcat


class Recorder:
    """Stands in for meshcat's window: keeps the commands instead of sending them to a server."""

    def __init__(self) -> None:
        self.commands: list[dict[str, Any]] = []

    def send(self, command: Any) -> None:
        """Keep one meshcat command."""
        self.commands.append(command.lower())


def render(title: str, recorder: Recorder, facts: dict[str, Any]) -> str:
    """The page as HTML; ``facts`` is what its script shows beside the scene (see _SCRIPT)."""
    arrays: dict[tuple[int, bytes], int] = {}

    def index(packed: Any) -> int:
        return arrays.setdefault((packed.type, packed.data), len(arrays))

    commands = json.dumps(recorder.commands, default=index)
    stored = [[_ARRAY_TYPES[kind], base64.b64encode(data).decode()] for kind, data in arrays]
    payload = f'{{"commands":{commands},"arrays":{json.dumps(stored)},"facts":{json.dumps(facts)}}}'
    assets = Path(meshcat.viewer_assets_path()) / "dist"
    pieces = {
        "TITLE": html.escape(title),
        "LICENCES": (assets / "main.min.js.THIRD_PARTY_LICENSES.json").read_text("utf-8").replace("<", "\\u003c"),
        "MESHCAT": (assets / "main.min.js").read_text("utf-8"),
        "PAYLOAD": base64.b64encode(gzip.compress(payload.encode(), compresslevel=6, mtime=0)).decode(),
        "SCRIPT": _SCRIPT,
    }
    return re.sub("@([A-Z]+)@", lambda mark: pieces[mark[1]], _PAGE)


class PageServer:
    """Serves one page on 127.0.0.1 from a thread of this process, until :meth:`close` or the process ends.

    Raises:
        InputError: if the port is taken or not allowed.
    """

    def __init__(self, page: str, port: int) -> None:
        body = page.encode()

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                found = self.path == "/"
                answer = body if found else b"not found"
                try:
                    self.send_response(200 if found else 404)
                    self.send_header("Content-Type", "text/html; charset=utf-8" if found else "text/plain")
                    self.send_header("Content-Length", str(len(answer)))
                    self.end_headers()
                    self.wfile.write(answer)
                except ConnectionError:
                    self.close_connection = True  # the browser went away

            def log_message(self, format: str, *args: object) -> None:
                """Say nothing."""

        try:
            self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        except (OSError, OverflowError) as error:
            raise InputError(f"cannot listen on port {port} of 127.0.0.1 ({error}): give another port") from None
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/"

    def wait(self) -> None:
        """Block until the server is closed or the user presses Ctrl-C, then close."""
        try:
            while self._thread.is_alive():
                self._thread.join(0.5)  # without a time limit Ctrl-C would not get through on every system
        except KeyboardInterrupt:
            pass
        finally:
            self.close()

    def close(self) -> None:
        """Stop serving and free the port; may be called twice."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def __enter__(self) -> PageServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>@TITLE@</title><link rel="icon" href="data:,">
<style>
body { margin: 0; overflow: hidden; font: 14px/1.4 system-ui, sans-serif; color: #222; }
#pane { width: 100vw; height: 100vh; }
.card { position: absolute; background: rgba(255, 255, 255, .88); border-radius: 8px; padding: 10px 14px;
  box-shadow: 0 1px 6px rgba(0, 0, 0, .25); }
#legend { left: 12px; top: 12px; max-width: calc(100vw - 60px); box-sizing: border-box; }
h1 { font-size: 15px; margin: 0 0 6px; }
td { padding: 1px 12px 1px 0; white-space: nowrap; font-variant-numeric: tabular-nums; }
td:nth-child(2) { max-width: min(22em, 25vw); overflow: hidden; text-overflow: ellipsis; }
td:nth-child(3) { min-width: 6.5em; }
.dot { display: inline-block; width: 12px; height: 12px; border-radius: 50%; margin-right: 5px; vertical-align: -1px; }
.hit { color: #c00018; font-weight: 600; }
#key { margin-top: 6px; padding-top: 6px; border-top: 1px solid #ccc; font-size: 13px; }
#key span, #key label { margin-right: 12px; white-space: nowrap; }
#player { left: 12px; right: 12px; bottom: 12px; display: flex; gap: 12px; align-items: center; }
#player button { width: 36px; height: 36px; border: 0; border-radius: 50%;
  background: #333; color: #fff; font-size: 14px; }
#track { flex: 1; }
#time { width: 100%; margin: 0; }
.strip { height: 7px; margin: 0 8px 3px; border-radius: 3px; }
#clock { min-width: 7.5em; text-align: right; font-variant-numeric: tabular-nums; }
</style>
</head>
<body>
<div id="pane"></div>
<div id="legend" class="card"><h1>@TITLE@</h1><table id="rows"></table><div id="key"></div></div>
<div id="player" class="card"><button id="play" aria-label="play or pause"></button>
<div id="track"><div id="strips"></div>
<input id="time" type="range" min="0" value="0" step="0.001" aria-label="time"></div>
<div id="clock"></div></div>
<script type="application/json" id="third-party-licences">@LICENCES@</script>
<script>@MESHCAT@</script>
<script type="text/plain" id="payload">@PAYLOAD@</script>
<script>@SCRIPT@</script>
</body>
</html>
"""

# facts = {fps, frames, camera: {eye, target} [m, y up], runs: [{label, color, body (path), states, clearance [m]}],
#          states: [{name, color or null for the robot's own}]}
_SCRIPT = """
const $ = (id) => document.getElementById(id);
const viewer = new MeshCat.Viewer($("pane"));

async function unpack() {
  const bytes = Uint8Array.from(atob($("payload").textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const {commands, arrays, facts} = JSON.parse(await new Response(stream).text());
  const decoded = arrays.map(([type, text]) =>
    new globalThis[type](Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer));
  for (const command of commands)
    for (const {data} of command.object?.geometries ?? [])
      for (const part of data ? [...Object.values(data.attributes), data.index] : [])
        if (part) part.array = decoded[part.array];
  return {commands, facts};
}

function add(parent, tag, properties) {
  return parent.appendChild(Object.assign(document.createElement(tag), properties));
}

function dot(parent, color) {
  add(parent, "i", {className: "dot"}).style.background = color;
}

function aim({eye, target}) {
  const far = Math.max(1, 1.25 / viewer.camera.aspect);  // tall windows need more distance
  viewer.camera.position.set(...eye.map((x, i) => target[i] + far * (x - target[i])));
  const distance = Math.hypot(...eye.map((x, i) => x - target[i]));
  Object.assign(viewer.camera, {fov: 45, near: distance / 200, far: distance * 100});
  viewer.controls.target.set(...target);
}

function legend({runs, states, frames}) {
  for (const run of runs) {
    const row = add($("rows"), "tr", {}), colors = states.map((s) => s.color ?? run.color);
    dot(add(row, "td", {}), run.color);
    add(row, "td", {textContent: run.label, title: run.label});
    Object.assign(run, {colors, state: add(row, "td", {}), distance: add(row, "td", {})});
    const stops = run.states.map((s, i) => `${colors[s]} ${100 * i / frames}% ${100 * (i + 1) / frames}%`);
    const strip = add($("strips"), "div", {className: "strip", title: run.label});
    strip.style.background = `linear-gradient(to right, ${stops.join()})`;
  }
  add($("key"), "span", {textContent: "filter:"});
  for (const {name, color} of states) {
    const item = add($("key"), "span", {});
    dot(item, color ?? `linear-gradient(to right, ${runs.map((r) => r.color).join()}, ${runs[0].color})`);
    item.append(name + (color ? "" : " (robot's colour)"));
  }
  add($("key"), "span", {textContent: "\\u25c7 goal"});
  const box = add(add($("key"), "label", {}), "input", {type: "checkbox", checked: true});
  box.after(" body spheres");
  box.onchange = () => {
    for (const run of runs) viewer.set_property(run.body, "visible", box.checked);
    viewer.set_dirty();
  };
}

function player({runs, states, fps, frames}) {
  const animator = viewer.animator, slider = $("time"), end = (frames - 1) / fps;
  slider.max = end;
  $("play").onclick = () => animator.playing ? animator.pause() : animator.play();
  slider.oninput = () => { animator.time = Number(slider.value); animator.seek(animator.time); };
  (function refresh() {
    requestAnimationFrame(refresh);
    const frame = Math.min(Math.round(animator.time * fps), frames - 1);
    slider.value = animator.time;
    $("play").textContent = animator.playing ? "\\u275a\\u275a" : "\\u25b6";
    $("clock").textContent = `${animator.time.toFixed(2)} / ${end.toFixed(2)} s`;
    for (const run of runs) {
      run.state.replaceChildren();
      dot(run.state, run.colors[run.states[frame]]);
      run.state.append(states[run.states[frame]].name);
      run.distance.textContent = `clearance ${run.clearance[frame].toFixed(3)} m`;
      run.distance.className = run.clearance[frame] < 0 ? "hit" : "";
    }
  })();
}

unpack().then(({commands, facts}) => {
  for (const command of commands) viewer.handle_command(command);
  viewer.set_3d_pane_size();
  aim(facts.camera);
  legend(facts);
  player(facts);
  document.body.dataset.ready = "yes";
});
"""

// A page that is opened from disk (file:) may start no Worker, and the search runs in one.
// This stands in for it: the same script, in a hidden frame. Elsewhere it does nothing.
if (location.protocol === "file:") {
  const frameOf = (url) => {
    const frame = document.createElement("iframe")
    frame.hidden = true
    document.body.appendChild(frame)
    frame.contentDocument.open()
    frame.contentDocument.write(
      `<html><body><script>
         postMessage = (data) => parent.__workers.get(window)(data)
         importScripts = (...urls) => urls.reduce((before, one) => before.then(() => new Promise((done, failed) => {
           const script = document.createElement("script")
           Object.assign(script, { src: one, onload: done, onerror: failed })
           document.body.appendChild(script)
         })), Promise.resolve())
       <\/script><script src="${url}"><\/script></body></html>`,
    )
    frame.contentDocument.close()
    return frame
  }
  window.__workers = new Map()
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      this.frame = frameOf(url)
      window.__workers.set(this.frame.contentWindow, (data) => {
        const event = new MessageEvent("message", { data })
        if (this.onmessage) this.onmessage(event)
        this.dispatchEvent(event)
      })
      this.ready = new Promise((done) => { this.frame.onload = done })
    }
    postMessage(data) {
      this.ready.then(() => this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data })))
    }
    terminate() {
      window.__workers.delete(this.frame.contentWindow)
      this.frame.remove()
    }
  }
}

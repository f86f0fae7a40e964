// Search where the site is opened from the disk: browsers start no workers there, so the
// script of the worker runs in a hidden frame, and messages go to and fro between windows.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      const mine = String(url)
      const frame = document.createElement("iframe")
      frame.hidden = true
      frame.srcdoc = `<body><script>
        self.postMessage = data => parent.postMessage({ worker: ${JSON.stringify(mine)}, data }, "*")
        self.receive = data => dispatchEvent(new MessageEvent("message", { data }))
        const load = url => new Promise((done, failed) => {
          const script = document.createElement("script")
          Object.assign(script, { src: url, onload: done, onerror: failed })
          document.body.append(script)
        })
        self.importScripts = (...urls) => urls.reduce((before, url) => before.then(() => load(url)), Promise.resolve())
        load(${JSON.stringify(mine)})
      <\/script></body>`
      this.ready = new Promise(done => frame.addEventListener("load", () => done(frame.contentWindow)))
      document.body.append(frame)
      window.addEventListener("message", event => {
        if (event.source !== frame.contentWindow || event.data?.worker !== mine) return
        const told = new MessageEvent("message", { data: event.data.data })
        this.dispatchEvent(told)
        this.onmessage?.(told)
      })
    }

    postMessage(data) {
      this.ready.then(frame => frame.receive(data))
    }

    terminate() {}
  }
}

# The session of the user guide, in tclsh beside the nodes of the Debian package. Any error ends it with status 1.
package require genomix
set g [::genomix::connect]
$g load bass; $g load rosAFE
::rosAFE::connect_port Audio bass/Audio
::bass::Acquire {device scene: sampleRate 44100 nFramesPerChunk 2205 nChunksOnPort 20} &
::rosAFE::InputProc {name input nFramesPerBlock 12000 bufferSize_s_port 1 bufferSize_s_getSignal 1} &
::rosAFE::PreProc {name preProc upperDepName input} &
::rosAFE::GammatoneProc {name gammatone upperDepName preProc fb_lowFreqHz 80 fb_highFreqHz 8000 fb_nERBs 1} &
::rosAFE::IhcProc {name ihc upperDepName gammatone ihc_method dau} &
::rosAFE::IldProc {name ild upperDepName ihc ild_wname hann ild_wSizeSec 0.02 ild_hSizeSec 0.01} &
::rosAFE::RatemapProc {name ratemap upperDepName ihc rm_wname hann rm_wSizeSec 0.02 rm_hSizeSec 0.01} &
::rosAFE::CrossCorrelationProc {name crosscorrelation upperDepName ihc cc_wSizeSec 0.02 cc_hSizeSec 0.01} &
set dependencies [::rosAFE::getDependencies {nameProc ratemap}]
if {![string match "*input*preProc*gammatone*ihc*ratemap*" $dependencies]} {error "dependencies: $dependencies"}
::rosAFE::modifyParameter {nameProc preProc nameParam pp_bRemoveDC newValue 1}
for {set tries 0} {[catch {::rosAFE::ildPort ild} ild] || ![regexp {data \{.*[1-9]} $ild]} {incr tries} {
  if {$tries == 150} {error "no level differences: [string range $ild 0 200]"}
  after 100
}
::rosAFE::Stop
puts "the session of the user guide succeeded"
exit 0
